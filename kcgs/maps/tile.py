"""The side of a tile, which tables of maps, kernels and compiled loops share."""

TILE = 16  # pixels
