"""Steps that look at the strongest Gaussians alone, which is what the first bytes of a file hold."""

from __future__ import annotations

import math

import numpy as np
from torch import Tensor

from .state import FitState, Gaussians

PREFIX_WEIGHT = 1.2
"""Of a prefix's gradient beside that of the whole, in its step."""
# shares of the Gaussians
_SHARES = (0.11, 0.16, 0.25, 0.385, 0.6)
# one in so many steps, from this share of a fit on
_EVERY, _FROM = 3, 0.06


def choose_prefix(state: FitState, progress: float) -> Gaussians | None:
    """Return what this step of a progressive fit renders alone; None: all Gaussians."""
    if state.config.objective != "progressive" or progress < _FROM:
        return None
    gaussians = state.gaussians()
    index = strongest(gaussians.cholesky, gaussians.colors, state.size, state.seed, state.iteration)
    return None if index is None else gaussians.pick(index)


def energies(cholesky: Tensor, colors: Tensor, size: tuple[int, int]) -> Tensor:
    """Return the squared colours times the area, which is at most the image's, (N,)."""
    area = (math.pi * cholesky[:, 0] * cholesky[:, 2]).clamp_max(size[0] * size[1])
    return colors.square().sum(-1) * area


def strongest(cholesky: Tensor, colors: Tensor, size: tuple[int, int], seed: int, iteration: int) -> Tensor | None:
    """Return the indices of a share of the Gaussians, in the order of a file; None in the iterations between."""
    if iteration % _EVERY != _EVERY - 1:
        return None
    share = float(np.random.default_rng([seed, iteration]).choice(_SHARES))
    energy = energies(cholesky, colors, size).detach()
    return energy.argsort(descending=True, stable=True)[: max(1, round(share * len(energy)))]
