"""Fit two colours across each contour: how soft the contour is, and how much error it explains.

A pair of regions gets the softness with the least error, summed over the windows along its contour.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcgs._check import check_number
from kcgs.errors import InvalidArgument, InvalidArgumentType
from kcgs.maps import MAX_SOFTNESS

from .contour_windows import ContourWindows, WindowErrors, measure_windows

CANDIDATES = (0.0, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8)  # pixels: from hard to out of focus, by factors of about sqrt(2)
_STEP = 0.05  # pixels that a softness between two candidates is rounded to
_MIN_EDGES = 12  # pixel edges that a pair needs to be judged by itself
_TIE = 1e-7  # mean squared error that counts as none: a tenth of the rounding of 8-bit images


class ContourGain(NamedTuple):
    """Mean squared errors along a contour: with the contour, and without it."""

    contour_error: float
    """Error of two linear colours mixed across the contour, at the best softness."""
    smooth_error: float
    """Error of one quadratic colour, which has as many coefficients."""
    share: float
    """Share of the smooth error that the contour saves, at most 1; three in four windows along it save more."""


@torch.no_grad()
def choose_softness(
    image: Tensor, labels: Tensor, *, candidates: Sequence[float] = CANDIDATES
) -> dict[tuple[int, int], float]:
    r"""Choose the softness of the contour between each two neighbouring regions that explains the image best.

    Convention: softness is the standard deviation of the blur of [M = r], as in `RegionMap`. A smaller candidate wins
    unless a larger one lowers the mean squared error by more than 1e-7, a tenth of the rounding of 8-bit images. A
    winner between two positive candidates is refined by a parabola to 0.05 pixels. Pairs with fewer than 12 pixel edges
    get the softness that is best for all pairs together.

    Known limits: softness near the largest candidate comes out low (2.5 as 2.4, and as 2.1 under noise and texture of
    a sixth of the contrast). Where the two sides have the same colours, the result means nothing.

    Args:
        image: floating, :math:`(C, H, W)`, in [0, 1].
        labels: integer label map, :math:`(H, W)`, non-negative.
        candidates: of softness, in pixels, 0 to 64.

    Returns:
        Softness in pixels for every pair (a, b), a < b, of labels that share a pixel edge; empty for one region.

    Raises:
        TypeError: wrong dtype, or candidates that are not numbers.
        ValueError: shapes that do not fit, values that are not finite, negative labels, candidates out of range.

    Example:
        >>> labels = (torch.arange(24) >= 12).long().repeat(24, 1)
        >>> choose_softness(0.2 + 0.5 * labels[None], labels)
        {(0, 1): 0.0}
    """
    candidates = _check_candidates(candidates)
    windows, parts = measure_windows(image, labels, candidates)
    errors = parts.sum_pairs(windows)
    tie = _TIE * errors.weight
    pooled = _best_softness(errors.soft.sum(0).tolist(), float(tie.sum()), candidates)
    return {
        (a, b): _best_softness(errors.soft[p].tolist(), float(tie[p]), candidates) if reliable else pooled
        for p, (a, b, reliable) in enumerate(_pairs(windows, errors))
    }


@torch.no_grad()
def contour_gain(image: Tensor, labels: Tensor) -> dict[tuple[int, int], ContourGain]:
    r"""Measure how much better the image is explained with the contour between each two neighbouring regions.

    Convention: arguments and exceptions are those of :func:`choose_softness`. Errors are means over the pixels of the
    two regions within about 6 pixels of their contour, tapered, in squared units of the image. Pairs with fewer than 12
    pixel edges get the values of all pairs together.

    Known limits: on 21 photos with human label maps, a share above 0.1 holds for 56 % of the pairs with at least 40
    pixel edges, and for 3 % where the map is mirrored.

    Returns:
        The errors for every pair (a, b), a < b, of labels that share a pixel edge; empty for one region.

    Example:
        >>> labels = (torch.arange(24) >= 12).long().repeat(24, 1)
        >>> contour_gain(0.2 + 0.5 * labels[None], labels)[0, 1].share > 0.99
        True
    """
    windows, parts = measure_windows(image, labels, CANDIDATES)
    errors = parts.sum_pairs(windows)
    pooled = _gain(parts)
    return {
        (a, b): _gain(WindowErrors(*(values[windows.pair == p] for values in parts))) if reliable else pooled
        for p, (a, b, reliable) in enumerate(_pairs(windows, errors))
    }


def _gain(windows: WindowErrors) -> ContourGain:
    """Return what a contour gains over some windows, at the softness that is best for all of them."""
    total = windows.weight.sum()
    if total == 0:
        return ContourGain(0.0, 0.0, 0.0)
    soft, smooth = windows.soft[:, windows.soft.sum(0).argmin()], windows.smooth
    shares = torch.where(smooth > _TIE * windows.weight, 1 - soft / smooth, 0.0)
    return ContourGain(float(soft.sum() / total), float(smooth.sum() / total), float(shares.quantile(0.25)))


def _pairs(windows: ContourWindows, errors: WindowErrors) -> list[tuple[int, int, bool]]:
    """Return each pair, and whether it has enough contour, and windows, to be judged by itself."""
    reliable = (windows.edges >= _MIN_EDGES) & (errors.weight > 0)
    return [(a, b, enough) for (a, b), enough in zip(windows.pairs.tolist(), reliable.tolist(), strict=True)]


def _best_softness(error: list[float], tie: float, candidates: Sequence[float]) -> float:
    """Return the first candidate whose error is within `tie` of the least, refined between its neighbours."""
    least = min(error)
    best = next(i for i, e in enumerate(error) if e <= least + tie)
    if best in (0, len(error) - 1) or error[best] > least or candidates[best - 1] == 0.0:
        return candidates[best]
    # two edges blurred by v and w differ by about (sqrt(v) - sqrt(w))^2, summed over pixels, if neither is near 0
    (x0, x1, x2), (y0, y1, y2) = map(math.sqrt, candidates[best - 1 : best + 2]), error[best - 1 : best + 2]
    left, right = (x1 - x0) * (y2 - y1), (x2 - x1) * (y0 - y1)
    if left + right <= tie:
        return candidates[best]
    vertex = x1 + 0.5 * ((x2 - x1) * right - (x1 - x0) * left) / (left + right)
    return round(round(vertex**2 / _STEP) * _STEP, 6)


def _check_candidates(candidates: Sequence[float]) -> list[float]:
    if isinstance(candidates, str) or not isinstance(candidates, Sequence):
        raise InvalidArgumentType("candidates", "a sequence of numbers", repr(candidates))
    if not candidates:
        raise InvalidArgument("candidates", "one or more numbers", "none")
    return sorted({check_number("each of candidates", c, 0.0, MAX_SOFTNESS, unit="pixels") for c in candidates})
