"""The separable Gaussian filter of metrics and contours, and the windows of matching pursuit."""

from __future__ import annotations

import math
from collections.abc import Sequence

from torch import Tensor


def gaussian_taps(sigma: float, radius: int) -> list[float]:
    """Return exp(-0.5 k^2 / sigma^2) for k = 0 to `radius`: the half of a symmetric window, its centre first."""
    return [1.0, *(math.exp(-0.5 * (k / sigma) ** 2) for k in range(1, radius + 1))]


def blur(maps: Tensor, taps: Sequence[float]) -> Tensor:
    """Filter (..., H, W) along both sides, one after the other, where the window lies inside.

    Sums of shifted copies are ten times faster on one core than torch's convolution of single channels.

    Args:
        maps: floating.
        taps: half of the symmetric window, its centre first.

    Returns:
        (..., H - 2k, W - 2k) for k + 1 taps.
    """
    window = [*taps[:0:-1], *taps]
    for dim in (-2, -1):
        length = maps.shape[dim] - len(window) + 1
        blurred = maps.narrow(dim, 0, length) * window[0]
        for k, tap in enumerate(window[1:], 1):
            blurred = blurred.add_(maps.narrow(dim, k, length), alpha=tap)
        maps = blurred
    return maps
