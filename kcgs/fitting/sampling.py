"""Pixels that are sampled in proportion to a weight."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]
Ints = NDArray[np.int64]


def sample_pixels(weights: Floats, count: int, rng: np.random.Generator) -> Ints:
    """Return positions sampled in proportion to weight, in order; without replacement while there are enough."""
    if count > len(weights):
        repeated = rng.choice(len(weights), count - len(weights), p=weights / weights.sum())
        return np.sort(np.concatenate([np.arange(len(weights)), repeated]))
    if count == len(weights):
        return np.arange(count)
    # the first arrivals of Poisson clocks of these rates
    arrivals = rng.standard_exponential(len(weights)) / weights
    return np.sort(np.argpartition(arrivals, count)[:count])


def spread_repeats(centres: Floats, pixels: Ints, rng: np.random.Generator) -> Floats:
    """Move every centre that shares its pixel with the one before it to a random place in that pixel."""
    repeated = np.flatnonzero(np.diff(pixels, prepend=-1) == 0)
    centres[repeated] += rng.uniform(-0.45, 0.45, (len(repeated), 2))
    return centres
