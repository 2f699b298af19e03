"""Windows along contours, in which an image is explained with the contour and without it.

In each window the image is explained as sum_r s_r F_r, with s_r the memberships at one softness and F_r linear in x and
y: a least-squares problem with a closed form. Mixed pixels are explained as mixtures, so that they spoil no colour, and
a thin region needs no pure pixel. Without the contour one quadratic colour explains the window.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcgs._check import check_floating
from kcgs._labels import check_labels
from kcgs.errors import InvalidArgument
from kcgs.maps import RADIUS_SIGMAS, contour_edges, truncated_gaussian, unique_pairs

_HALF = 6  # pixels that a window reaches from its centre, or twice the largest candidate if that is more
_CELL = 6  # pixels: one window for each cell of this side that the contour of a pair crosses
_PAIR_WINDOWS = 512  # most windows of one pair of regions, evenly spread; it bounds the time
_ALL_WINDOWS = 4096  # most windows of a map
_CHUNK_ELEMENTS = 1 << 18  # label pixels in a chunk of windows: small enough for the cache
_GPU_CHUNK_ELEMENTS = 1 << 22  # on a GPU, where each chunk takes two hundred operations
# noise of 0.02, and colours and slopes (over half a window) of 0.3: the ridge keeps a region that hardly shows from
# explaining everything with an absurd colour
_RIDGE = (0.02 / 0.3) ** 2


class ContourWindows(NamedTuple):
    """The pairs of regions that touch, and windows along their contours."""

    pairs: Tensor  # [P, 2] int64, labels a < b
    edges: Tensor  # [P] int64, pixel edges between a and b
    pair: Tensor  # [K] int64, the pair of each window
    centers: Tensor  # [K, 2] int64, row and column


class WindowErrors(NamedTuple):
    """What the best fits of windows, or of pairs of regions, leave unexplained."""

    soft: Tensor  # [K or P, S] float64, squared error at each softness
    smooth: Tensor  # [K or P] float64, squared error without the contour
    weight: Tensor  # [K or P] float64, tapered pixels times channels

    def sum_pairs(self, windows: ContourWindows) -> WindowErrors:
        """Return the sums over the windows of each pair."""
        count = len(windows.pairs)
        return WindowErrors(*(e.new_zeros(count, *e.shape[1:]).index_add_(0, windows.pair, e) for e in self))


def measure_windows(image: Tensor, labels: Tensor, candidates: Sequence[float]) -> tuple[ContourWindows, WindowErrors]:
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
    return windows, WindowErrors(*map(torch.cat, zip(*parts, strict=True)))


def check_image_and_labels(image: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
    """Return an image (C, H, W), and a label map of its size on the CPU.

    Windows are summed on the image's device: on a GPU in float64, whose products no setting of torch makes less exact.
    """
    image = check_floating("image", image, dims=(3,))
    labels = check_labels("labels", labels, dims=(2,))
    if image.shape[0] == 0 or image.shape[1:] != labels.shape:
        raise InvalidArgument(
            "image", f"shape (C, {labels.shape[0]}, {labels.shape[1]}) with labels", tuple(image.shape), verb="have"
        )
    return image.double() if image.is_cuda else image.float().cpu(), labels.cpu()


def _place_windows(labels: Tensor) -> ContourWindows:
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
    return ContourWindows(pairs, edges, pair[sample], centers[sample])


def _spread(group: Tensor, most: int) -> Tensor:
    """Return the places of at most `most` elements of each group (sorted ids), evenly spread."""
    count = group.bincount()
    rank = torch.arange(len(group)) - (count.cumsum(0) - count)[group]
    return (rank * most % count[group] < most).nonzero().flatten()


def _blur_matrix(softness: float, side: int, halo: int) -> Tensor:
    """Return the matrix that blurs `side + 2 halo` samples to the inner `side` samples."""
    distance = (torch.arange(side)[:, None] + halo - torch.arange(side + 2 * halo)).abs().float()
    return truncated_gaussian(distance, softness)


def _window_errors(pixels: Tensor, ids: Tensor, pairs: Tensor, kernels: list[Tensor]) -> WindowErrors:
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
    return WindowErrors(torch.stack(soft, 1), smooth, weight.sum(1).cpu().double() * pixels.shape[2])


def _explained_energy(features: Tensor, pixels: Tensor, weight: Tensor) -> Tensor:
    """Return the energy of the best mix of features (K, F, side^2), with a ridge on its coefficients."""
    weighted = features * weight[:, None]
    gram, moment = (weighted @ features.mT).cpu().double(), (weighted @ pixels).cpu().double()
    gram.diagonal(dim1=-2, dim2=-1).add_(_RIDGE * weight.shape[1] / (2 * _HALF + 1) ** 2)
    explained: Tensor = torch.linalg.solve_triangular(torch.linalg.cholesky(gram), moment, upper=False)
    return explained.square().sum((1, 2))
