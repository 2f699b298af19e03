"""Pixels that are sampled in proportion to a weight."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]
Ints = NDArray[np.int64]


def sample_pixels(weights: Floats, count: int, rng: np.random.Generator) -> Ints:
    """Return `count` different positions, sampled in proportion to weight, in order."""
    if count == len(weights):
        return np.arange(count)
    # the first arrivals of Poisson clocks of these rates
    arrivals = rng.standard_exponential(len(weights)) / weights
    return np.sort(np.argpartition(arrivals, count)[:count])
