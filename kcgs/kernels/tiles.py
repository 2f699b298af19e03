"""Tiles of 16 x 16 pixels, and which Gaussian touches which tile; for `tiled`, `cuda` and the ONNX decoders."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kcgs.maps import TILE

from .interface import SplatInputs
from .whitened import Z_LIMIT, affine_coefficients, least_shear

# margins of the bounds of a support, so that they hold for weights in float32: relative, and in pixels
RELATIVE_MARGIN = 1e-5
MARGIN = 1e-3


class TileGrid(NamedTuple):
    """Tiles over a batch of images, numbered in raster order, batch first."""

    batch: int
    rows: int
    cols: int

    @property
    def total(self) -> int:
        """Number of tiles over the whole batch."""
        return self.batch * self.rows * self.cols


def grid_of(inputs: SplatInputs) -> TileGrid:
    """Return the tiles that cover the batch."""
    height, width = inputs.size
    return TileGrid(inputs.num_images, -(-height // TILE), -(-width // TILE))


def bounding_tiles(
    means: Tensor, cholesky: Tensor, radius: float, size: tuple[int, int], *, between: bool = False
) -> tuple[Tensor, Tensor, Tensor]:
    """List the tiles that the bounding box of each float64 Gaussian's support touches.

    Args:
        means: (N, 2) pixels.
        cholesky: (N, 3) pixels.
        radius: of the support, in standard deviations.
        size: of the image.
        between: whether a box touches a tile if it holds any point of it, rather than the centre of a pixel.

    Returns:
        Ordered by Gaussian: its index (P,), the tile's column and row (P, 2), the tile's centre minus the mean (P, 2).
    """
    l11, l21, l22 = cholesky.unbind(-1)
    extent = torch.stack([l11, torch.hypot(l21, l22)], -1) * radius * (1 + RELATIVE_MARGIN) + MARGIN
    last = torch.as_tensor(size, device=means.device, dtype=means.dtype).flip(-1) - 1
    if between:
        last = (last / TILE).floor() * TILE + (TILE - 1)
        low, high = (means - extent).floor(), (means + extent).floor()
    else:
        low, high = (means - extent - 0.5).ceil(), (means + extent - 0.5).floor()
    is_inside = ((low <= high) & (high >= 0) & (low <= last)).all(-1)
    first, final = ((pixel.clamp_min(0).minimum(last) / TILE).floor().long() for pixel in (low, high))
    across, down = (final - first + 1).unbind(-1)
    gaussian, rank = expand_runs(torch.where(is_inside, across * down, 0))
    across = across[gaussian]
    place = first[gaussian] + torch.stack([rank % across, rank // across], -1)
    return gaussian, place, place * float(TILE) + TILE / 2 - means[gaussian]


def reaches(origin: Tensor, cholesky: Tensor, radius: float) -> Tensor:
    """Tell which tiles of a bounding box the support itself may touch."""
    # the bounding box bounds z1
    l11, l21, l22 = cholesky.unbind(-1)
    x, y = origin.unbind(-1)
    nearest = least_shear(x, y, l21 / l11, (TILE - 1) / 2)
    return nearest <= radius * (1 + RELATIVE_MARGIN) * l22 + MARGIN


def find_keys(keys: Tensor, tile: Tensor, region: Tensor, num_regions: int) -> tuple[Tensor, Tensor]:
    """Return the place of tile * num_regions + region among sorted keys, and if it is there; region -1 never is."""
    key = torch.where(region >= 0, tile * num_regions + region, -1)
    position = torch.searchsorted(keys, key).clamp_max(len(keys) - 1)
    return position, keys[position] == key


def coefficients(origin: Tensor, cholesky: Tensor) -> Tensor:
    """Return k, (P, 5), of z1 = k0 + k1 x, z2 = k2 + k3 x + k4 y in pixels from the tile's centre, in float64."""
    rows = torch.stack(affine_coefficients(*origin.unbind(-1), *cholesky.unbind(-1)), -1)
    return rows.clamp(-Z_LIMIT, Z_LIMIT)


def split_into_tiles(image: Tensor) -> Tensor:
    """View (B, C, H, W) as (B, rows, cols, C, TILE, TILE), zero outside."""
    height, width = image.shape[-2:]
    padded = torch.nn.functional.pad(image, (0, -width % TILE, 0, -height % TILE))
    batch, channels, *sides = padded.shape
    return padded.reshape(batch, channels, sides[0] // TILE, TILE, sides[1] // TILE, TILE).permute(0, 2, 4, 1, 3, 5)


def join_tiles(tiles: Tensor, size: tuple[int, int]) -> Tensor:
    """Return the image of (B, rows, cols, C, TILE, TILE): the inverse of `split_into_tiles`."""
    batch, rows, cols, channels = tiles.shape[:4]
    image = tiles.permute(0, 3, 1, 4, 2, 5).reshape(batch, channels, rows * TILE, cols * TILE)
    return image[..., : size[0], : size[1]].contiguous()


def expand_runs(counts: Tensor) -> tuple[Tensor, Tensor]:
    """Return, for each member of consecutive runs of these lengths, the number of its run and its position in it."""
    run = torch.repeat_interleave(counts)
    return run, torch.arange(len(run), device=run.device) - (counts.cumsum(0) - counts)[run]


def sum_runs(values: Tensor, counts: Tensor) -> Tensor:
    """Sum consecutive runs of rows; the order of addition is the same every time, on any device."""
    if len(counts) == 0:
        return values.new_zeros(0, values.shape[-1])
    return torch.segment_reduce(values, "sum", lengths=counts, axis=0, initial=0.0)
