"""Fit two colours across each contour: how soft the contour is, and how much error it explains.

Along a contour lie square windows. In each window the image is explained as sum_r s_r F_r, with s_r the memberships at
one softness and F_r linear in x and y: a least-squares problem with a closed form. Mixed pixels are explained as
mixtures, so that they spoil no colour, and a thin region needs no pure pixel. A pair of regions gets the softness with
the least error, summed over its windows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcgs._check import check_floating, check_number
from kcgs._labels import check_labels
from kcgs.maps import MAX_SOFTNESS, RADIUS_SIGMAS, contour_edges, truncated_gaussian, unique_pairs

CANDIDATES = (0.0, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8)  # pixels: from hard to out of focus, by factors of about sqrt(2)
_STEP = 0.05  # pixels that a softness between two candidates is rounded to
_MIN_EDGES = 12  # pixel edges that a pair needs to be judged by itself

_HALF = 6  # pixels that a window reaches from its centre, or twice the largest candidate if that is more
_CELL = 6  # pixels: one window for each cell of this side that the contour of a pair crosses
_PAIR_WINDOWS = 512  # most windows of one pair of regions, evenly spread; it bounds the time
_ALL_WINDOWS = 4096  # most windows of a map
_CHUNK_ELEMENTS = 1 << 18  # label pixels in a chunk of windows: small enough for the cache
_GPU_CHUNK_ELEMENTS = 1 << 22  # on a GPU, where each chunk takes two hundred operations
# noise of 0.02, and colours and slopes (over half a window) of 0.3: the ridge keeps a region that hardly shows from
# explaining everything with an absurd colour
_RIDGE = (0.02 / 0.3) ** 2
_TIE = 1e-7  # mean squared error that counts as none: a tenth of the rounding of 8-bit images


class ContourGain(NamedTuple):
    """Mean squared errors along a contour: with the contour, and without it."""

    contour_error: float
    """Error of two linear colours mixed across the contour, at the best softness."""
    smooth_error: float
    """Error of one quadratic colour, which has as many coefficients."""
    share: float
    """Share of the smooth error that the contour saves, at most 1; three in four windows along it save more."""


class _Windows(NamedTuple):
    pairs: Tensor  # [P, 2] int64, labels a < b
    edges: Tensor  # [P] int64, pixel edges between a and b
    pair: Tensor  # [K] int64, the pair of each window
    centers: Tensor  # [K, 2] int64, row and column


class _Errors(NamedTuple):
    soft: Tensor  # [K or P, S] float64, squared error at each softness
    smooth: Tensor  # [K or P] float64, squared error without the contour
    weight: Tensor  # [K or P] float64, tapered pixels times channels

    def sum_pairs(self, windows: _Windows) -> _Errors:
        """Return the sums over the windows of each pair."""
        count = len(windows.pairs)
        return _Errors(*(e.new_zeros(count, *e.shape[1:]).index_add_(0, windows.pair, e) for e in self))


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
    windows, parts = _measure(image, labels, candidates)
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
    windows, parts = _measure(image, labels, CANDIDATES)
    errors = parts.sum_pairs(windows)
    pooled = _gain(parts)
    return {
        (a, b): _gain(_Errors(*(values[windows.pair == p] for values in parts))) if reliable else pooled
        for p, (a, b, reliable) in enumerate(_pairs(windows, errors))
    }


def _gain(windows: _Errors) -> ContourGain:
    """Return what a contour gains over some windows, at the softness that is best for all of them."""
    total = windows.weight.sum()
    if total == 0:
        return ContourGain(0.0, 0.0, 0.0)
    soft, smooth = windows.soft[:, windows.soft.sum(0).argmin()], windows.smooth
    shares = torch.where(smooth > _TIE * windows.weight, 1 - soft / smooth, 0.0)
    return ContourGain(float(soft.sum() / total), float(smooth.sum() / total), float(shares.quantile(0.25)))


def _pairs(windows: _Windows, errors: _Errors) -> list[tuple[int, int, bool]]:
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


def _measure(image: Tensor, labels: Tensor, candidates: Sequence[float]) -> tuple[_Windows, _Errors]:
    """Check image and labels, place the windows, and return each window's errors at each softness, ascending."""
    image, labels = check_image_and_labels(image, labels)
    windows = _place_windows(labels)
    half, halo = max(_HALF, math.ceil(2 * candidates[-1])), math.ceil(RADIUS_SIGMAS * candidates[-1])
    side, span = 2 * half + 1, 2 * (half + halo) + 1
    windowed = torch.nn.functional.pad(image, (half,) * 4).unfold(1, side, 1).unfold(2, side, 1)
    labels = torch.nn.functional.pad(labels.to(image.device), (half + halo,) * 4, value=-1)
    ids = labels.unfold(0, span, 1).unfold(1, span, 1)
    kernels = [_blur_matrix(softness, side, halo).to(image) for softness in candidates]
    parts = []
    step = max(1, (_GPU_CHUNK_ELEMENTS if image.is_cuda else _CHUNK_ELEMENTS) // span**2)
    for centers, pair in zip(windows.centers.split(step), windows.pair.split(step), strict=True):
        rows, cols = centers.to(image.device).unbind(1)
        pixels = windowed[:, rows, cols].flatten(2).permute(1, 2, 0)
        parts.append(_window_errors(pixels, ids[rows, cols], windows.pairs[pair].to(image.device), kernels))
    return windows, _Errors(*map(torch.cat, zip(*parts, strict=True)))


def check_image_and_labels(image: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
    """Return an image (C, H, W), and a label map of its size on the CPU.

    Windows are summed on the image's device: on a GPU in float64, whose products no setting of torch makes less exact.
    """
    image = check_floating("image", image, dims=(3,))
    labels = check_labels("labels", labels, dims=(2,))
    if image.shape[0] == 0 or image.shape[1:] != labels.shape:
        raise ValueError(
            f"image must have shape (C, {labels.shape[0]}, {labels.shape[1]}) with labels; got {tuple(image.shape)}"
        )
    return image.double() if image.is_cuda else image.float().cpu(), labels.cpu()


def _check_candidates(candidates: Sequence[float]) -> list[float]:
    if isinstance(candidates, str) or not isinstance(candidates, Sequence):
        raise TypeError(f"candidates must be a sequence of numbers; got {candidates!r}")
    if not candidates:
        raise ValueError("candidates must be one or more numbers; got none")
    return sorted({check_number("each of candidates", c, 0.0, MAX_SOFTNESS, unit="pixels") for c in candidates})


def _place_windows(labels: Tensor) -> _Windows:
    """Find the pairs that share a pixel edge; put a window on every cell of the image that their contour crosses."""
    height, width = labels.shape
    ends, places = contour_edges(labels)
    pairs, pair, edges = unique_pairs(ends)
    cells_x = math.ceil(width / _CELL)
    cells = cells_x * math.ceil(height / _CELL)
    codes, cell, size = (pair * cells + places[:, 0] // _CELL * cells_x + places[:, 1] // _CELL).unique(
        return_inverse=True, return_counts=True
    )
    sums = torch.zeros(len(codes), 2, dtype=torch.int64).index_add_(0, cell, places)
    centers, pair = (2 * sums + size[:, None]) // (2 * size[:, None]), codes // cells
    sample = _spread(pair, _PAIR_WINDOWS)
    sample = sample[_spread(torch.zeros_like(sample), _ALL_WINDOWS)]
    return _Windows(pairs, edges, pair[sample], centers[sample])


def _spread(group: Tensor, most: int) -> Tensor:
    """Return the places of at most `most` elements of each group (sorted ids), evenly spread."""
    count = group.bincount()
    rank = torch.arange(len(group)) - (count.cumsum(0) - count)[group]
    return (rank * most % count[group] < most).nonzero().flatten()


def _blur_matrix(softness: float, side: int, halo: int) -> Tensor:
    """Return the matrix that blurs `side + 2 halo` samples to the inner `side` samples."""
    distance = (torch.arange(side)[:, None] + halo - torch.arange(side + 2 * halo)).abs().float()
    return truncated_gaussian(distance, softness)


def _window_errors(pixels: Tensor, ids: Tensor, pairs: Tensor, kernels: list[Tensor]) -> _Errors:
    """Explain windows of pixels (K, side^2, C), with labels out to the blur's reach (-1: outside the image).

    Sums over pixels are taken on their device; the equations of each window are solved on the CPU.
    """
    side = kernels[0].shape[0]
    halo = (ids.shape[-1] - side) // 2
    inside = ids[:, None] == pairs[:, :, None, None]  # [K, 2, span, span]
    y, x = torch.meshgrid(*[torch.linspace(-1, 1, side, dtype=pixels.dtype, device=pixels.device)] * 2, indexing="ij")
    one, taper = torch.ones_like(x), torch.exp(-2 * (x * x + y * y))
    # pixels of other regions have no weight; their blur into the pair's pixels is one more unknown colour
    weight = (taper * inside[..., halo : halo + side, halo : halo + side].any(1)).flatten(1)  # [K, side^2]
    pixels = pixels - (weight[..., None] * pixels).sum(1, keepdim=True) / weight.sum(1)[:, None, None]
    linear = torch.stack([one, x, y]).flatten(1)
    quadratic = torch.stack([one, x, y, x * x, x * y, y * y]).flatten(1).expand(len(ids), -1, -1)
    down, across = (ids >= 0).any(2).to(pixels), (ids >= 0).any(1).to(pixels)  # [K, span]
    energy = (weight[..., None] * pixels.square()).sum((1, 2)).cpu().double()
    mask, soft = inside.to(pixels), []
    for kernel in kernels:
        total = (down @ kernel.T)[:, :, None] * (across @ kernel.T)[:, None, :]
        membership = (kernel @ mask @ kernel.T / total[:, None].clamp_min(1e-30)).flatten(2)  # [K, 2, side^2]
        features = (membership[:, :, None] * linear).flatten(1, 2)
        others = 1 - membership.sum(1, keepdim=True)
        soft.append(energy - _explained_energy(torch.cat([features, others], 1), pixels, weight))
    smooth = energy - _explained_energy(quadratic, pixels, weight)
    return _Errors(torch.stack(soft, 1), smooth, weight.sum(1).cpu().double() * pixels.shape[2])


def _explained_energy(features: Tensor, pixels: Tensor, weight: Tensor) -> Tensor:
    """Return the energy of the best mix of features (K, F, side^2), with a ridge on its coefficients."""
    weighted = features * weight[:, None]
    gram, moment = (weighted @ features.mT).cpu().double(), (weighted @ pixels).cpu().double()
    gram.diagonal(dim1=-2, dim2=-1).add_(_RIDGE * weight.shape[1] / (2 * _HALF + 1) ** 2)
    explained: Tensor = torch.linalg.solve_triangular(torch.linalg.cholesky(gram), moment, upper=False)
    return explained.square().sum((1, 2))
