"""Where new Gaussians should go: matching pursuit on the error, over places and scales, inside each region."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcgs.functional import RegionMap, region_splat
from kcgs.functional.blur import gaussian_taps
from kcgs.nn import GaussianField
from kcgs.nn.field import join

# reach of the discrete Gaussians, in standard deviations
_REACH = 3.0
# standard deviation of the search's Gaussians in blocks, at least
_SIGMA_PER_BLOCK = 0.9
# candidates for each Gaussian to be added
_CANDIDATES_PER_GAUSSIAN = 16
_MIN_CANDIDATES = 4096
# two Gaussians whose normalised inner product is above this explain the same error: 2.5 sigma apart, at one scale
_OVERLAP = 0.2
_CUTOFF = 1e-4
# pixels of crops that are searched at once
_CROP_PIXELS = 1 << 16
# pixels of a task of the search
_TASK_PIXELS = 1 << 13
# Standard deviations that are tried, in pixels. More of them cost time, and descent changes them anyway.
SIGMAS = (0.7, 1.1, 1.8, 2.9, 4.7, 7.5)

Array = NDArray[Any]


class _Candidates(NamedTuple):
    """Places to try, M of them."""

    region: Array  # [M], position in the map's ids
    x: Array  # [M], pixels
    y: Array  # [M]
    sigma: Array  # [M]
    block: Array  # [M], side in pixels of the block that x, y is the middle of
    inner: Array  # [M, C], <g, residual>
    norm: Array  # [M], <g, g>
    gain: Array  # [M], fall of the squared error

    def take(self, positions: NDArray[np.int64]) -> _Candidates:
        """Return those at these positions."""
        return _Candidates(*(column[positions] for column in self))


class _Crops(NamedTuple):
    """Boxes of R regions of the same size."""

    regions: Array  # [R], position in the map's ids
    corners: Array  # [R, 2], first row and column
    planes: Tensor  # [R, C + 1, h, w], the residual inside the region, zero outside, and the mask


def propose(
    residual: Tensor, regions: RegionMap | None, count: int, *, sigmas: Sequence[float] = SIGMAS, backend: str = "auto"
) -> GaussianField:
    r"""Find at most `count` round Gaussians that lower the squared error most when they are added to the render.

    A Gaussian g lowers it by :math:`\sum_c \langle g, e_c \rangle^2 / \langle g, g \rangle`, with products over pixels
    of its region. Contours are hard in the search, and centres are those of pixels; nothing is sampled at random. The
    strongest come first.
    """
    residual = residual.detach()
    index = torch.zeros_like(residual[0], dtype=torch.int32) if regions is None else regions.index[0]
    labels = index.cpu().numpy()
    # below this the gain is rounding error: one pixel's, at the precision of the largest
    floor = (128 * torch.finfo(residual.dtype).eps * float(residual.abs().max())) ** 2
    ids = None if regions is None else regions.ids[:0]
    empty = residual.new_zeros
    size = (residual.shape[1], residual.shape[2])
    field = GaussianField(empty(0, 2), empty(0, 3), empty(0, len(residual)), ids, size=size)
    while (missing := count - field.num_gaussians) > 0:
        candidates = _pursue(_search(residual, labels, sigmas, missing), missing, floor)
        if not len(candidates.x):
            break
        part, rendered = _place(candidates, residual, labels, regions, backend)
        if not bool(part.colors.any()):
            break
        field = join(field, part)
        residual = residual - rendered
    return field


def _search(residual: Tensor, labels: NDArray[np.int32], sigmas: Sequence[float], count: int) -> _Candidates:
    """Evaluate every place and scale of every region; keep the best of each square, and of those the strongest."""
    from scipy.ndimage import find_objects

    limit = max(_CANDIDATES_PER_GAUSSIAN * count, _MIN_CANDIDATES)
    scales = {block: [s for s in sigmas if _block(s) == block] for block in sorted(map(_block, sigmas))}
    parts: list[_Candidates] = []
    least = 0.0
    for crops in _crop_regions(residual, labels, find_objects(labels + 1), 2 * max(scales)):
        averages, side = crops.planes, 1
        for block, choices in scales.items():
            while side < block:
                averages, side = halve(averages), 2 * side
            for sigma in choices:
                parts.append(_best_of_squares(crops, averages, sigma, block, limit, least))
                if len(parts[-1].gain) == limit:  # what is less cannot be among the strongest
                    least = max(least, parts[-1].gain.min())
    everywhere = _Candidates(*(np.concatenate(values) for values in zip(*parts, strict=True)))
    strong = everywhere.take(_strongest(everywhere.gain, limit))
    return strong.take(np.lexsort((strong.sigma, strong.x, strong.y, strong.region)))


def _crop_regions(residual: Tensor, labels: NDArray[np.int32], boxes: list[Any], align: int) -> Iterator[_Crops]:
    """Crop the residual to each region's box, begun and filled up to multiples of `align`; boxes of a size together."""
    corners, sizes = {}, {}
    for region, box in enumerate(boxes):
        if box is not None:
            corners[region] = [side.start // align * align for side in box]
            sizes[region] = tuple(
                -(-(side.stop - start) // align) * align for side, start in zip(box, corners[region], strict=True)
            )
    for height, width in sorted(set(sizes.values())):
        members = [region for region, size in sizes.items() if size == (height, width)]
        count = max(1, _CROP_PIXELS // (height * width))
        for first in range(0, len(members), count):
            group = members[first : first + count]
            planes = residual.new_zeros(len(group), len(residual) + 1, height, width)
            for plane, region in zip(planes, group, strict=True):
                top, left = corners[region]
                mask = torch.from_numpy(labels[top : top + height, left : left + width] == region)
                inside = plane[:, : mask.shape[0], : mask.shape[1]]
                inside[-1] = mask
                torch.mul(residual[:, top : top + height, left : left + width], inside[-1], out=inside[:-1])
            yield _Crops(np.array(group), np.array([corners[region] for region in group]), planes)


def _block(sigma: float) -> int:
    """Side of the blocks that the residual is averaged over: a power of 2, at most sigma / 0.9."""
    return int(2 ** max(0, math.floor(math.log2(sigma / _SIGMA_PER_BLOCK))))


def halve(planes: Tensor) -> Tensor:
    """Average blocks of 2 x 2, (..., h, w), without an odd last row; five times faster on one core than torch's."""
    rows = planes[..., : planes.shape[-2] // 2 * 2 : 2, :] + planes[..., 1::2, :]
    return (rows[..., : rows.shape[-1] // 2 * 2 : 2] + rows[..., 1::2]).mul_(0.25)


def _best_of_squares(crops: _Crops, planes: Tensor, sigma: float, block: int, limit: int, least: float) -> _Candidates:
    """Gains at every block of some regions, at one scale; the best of each square of blocks, the `limit` best of those.

    `planes`, (R, C + 1, h, w), are the crops' planes, averaged over blocks. Gains are positive, and at least `least`.
    """
    from kcgs.kernels.tasks import ranges, run_tasks  # loads numba

    from .pursuit_loops import find_best_places

    side = 2 if block == 1 or sigma / block >= _SIGMA_PER_BLOCK * math.sqrt(2) else 1
    count, channels, height, width = planes.shape
    shape, values = (count, height // side, width // side), planes.cpu().contiguous().numpy()
    squares = (
        np.empty(shape, values.dtype), np.empty(shape, np.int64), np.empty((*shape, channels - 1), values.dtype),
        np.empty(shape, values.dtype),
    )  # fmt: skip
    # g^2 is a Gaussian too, narrower by sqrt 2
    taps, norm_taps = (_window(width, values.dtype) for width in (sigma / block, sigma / block / math.sqrt(2)))
    tasks = ranges(count * shape[1], max(1, _TASK_PIXELS // (side * width)))
    run_tasks(partial(find_best_places, values, taps, norm_taps, values.dtype.type(block**2), squares), tasks)
    gains, places, products, norms = (part.reshape(-1, *part.shape[3:]) for part in squares)
    positive = np.flatnonzero((gains > 0) & (gains >= least))
    strongest = positive[_strongest(gains[positive], limit)]
    crop, (rows, columns) = strongest // (shape[1] * shape[2]), np.divmod(places[strongest], width)
    return _Candidates(
        crops.regions[crop], crops.corners[crop, 1] + (columns + 0.5) * block,
        crops.corners[crop, 0] + (rows + 0.5) * block, np.full(len(crop), sigma), np.full(len(crop), block),
        products[strongest], norms[strongest], gains[strongest],
    )  # fmt: skip


def _window(sigma: float, dtype: Any) -> Array:
    """Values of exp(-0.5 d^2 / sigma^2) at pixels, the middle one at 0."""
    half = gaussian_taps(sigma, math.ceil(_REACH * sigma))
    return np.array([*half[:0:-1], *half], dtype)


def _strongest(gain: Array, limit: int) -> NDArray[np.int64]:
    """Positions of the `limit` largest gains, of equal ones the first; in order of position."""
    if len(gain) <= limit:
        return np.arange(len(gain))
    least = np.partition(gain, len(gain) - limit)[len(gain) - limit]
    above, equal = np.flatnonzero(gain > least), np.flatnonzero(gain == least)
    return np.sort(np.concatenate([above, equal[: limit - len(above)]]))


def _pursue(candidates: _Candidates, count: int, floor: float) -> _Candidates:
    """Pick the largest gain, subtract its share of the error from its neighbours', and again; the strongest first.

    Inner products of two Gaussians are those of the plane, or with the norms inside the region for the squared widths
    where that is more: in a region of one pixel all scales are the same. A candidate that overlaps too much with a
    picked one is dropped, since there the approximation ends.
    """
    from .pursuit_loops import choose  # loads numba

    picked = np.zeros(min(count, len(candidates.gain)), np.int64)
    if not len(picked):
        return candidates.take(picked)
    share = candidates.inner / np.sqrt(candidates.norm)[:, None]  # [M, C], of normalised Gaussians
    # sorted by region, then y: those near a place are within one stretch
    stride = 4.0 * (candidates.y.max() + 1.0)
    places = np.stack([candidates.x, candidates.y, candidates.region * stride + candidates.y], -1)
    columns = (places, candidates.sigma**2, candidates.norm, share, candidates.gain)
    numbers = (np.array(column, np.float64, order="C") for column in columns)
    return candidates.take(picked[: choose(*numbers, (floor, _OVERLAP, _REACH, stride / 4), picked)])


def _place(
    candidates: _Candidates, residual: Tensor, labels: NDArray[np.int32], regions: RegionMap | None, backend: str
) -> tuple[GaussianField, Tensor]:
    """Snap the centres to pixels of their region, and render in the colours of steepest descent."""
    means = torch.from_numpy(_pixel_of_region(candidates, labels)).to(residual)
    sigma = torch.from_numpy(candidates.sigma).to(residual)
    cholesky = torch.stack([sigma, torch.zeros_like(sigma), sigma], -1)
    ids = None
    if regions is not None:
        ids = regions.ids[torch.from_numpy(candidates.region).to(residual.device)]
    colors = torch.from_numpy(candidates.inner / candidates.norm[:, None]).to(residual)
    size = residual.shape[1], residual.shape[2]
    with torch.no_grad():
        rendered = region_splat(means, cholesky, colors, ids, regions, size=size, cutoff=_CUTOFF, backend=backend)
        # Gaussians overlap: steps of the best length make the fall of the error certain
        hard = regions is None or regions.softness == 0
        # under a soft contour regions mix: one length for all
        index = torch.from_numpy(labels * hard).to(residual.device, torch.int64)
        length = _best_lengths(rendered, residual, index)
        part = torch.from_numpy(candidates.region * hard).to(index)
        field = GaussianField(means, cholesky, colors * length[part, None], ids, size=size)
        return field, rendered * length[index]


def _best_lengths(rendered: Tensor, residual: Tensor, index: Tensor) -> Tensor:
    """Factor of the render that leaves the least squared error, for each part of the image, (R,)."""
    product, square = (
        torch.bincount(index.flatten(), (rendered * other).sum(0).flatten()) for other in (residual, rendered)
    )
    return (product / square.clamp_min(torch.finfo(rendered.dtype).tiny)).to(rendered.dtype)


def _pixel_of_region(candidates: _Candidates, labels: NDArray[np.int32]) -> NDArray[np.float64]:
    """Centre of the pixel of the region nearest to the middle of each block, (K, 2)."""
    height, width = labels.shape
    # the middle of a block is the middle of a pixel or the corner of four: the upper left one is the first of these
    rows, cols = (np.floor(values - 0.5).astype(np.int64) for values in (candidates.y, candidates.x))
    fits = labels[rows.clip(max=height - 1), cols.clip(max=width - 1)] == candidates.region
    fits &= (rows < height) & (cols < width)
    for i in np.flatnonzero(~fits):
        block = int(candidates.block[i])
        top, left = round(candidates.y[i] - block / 2), round(candidates.x[i] - block / 2)
        down, across = np.nonzero(labels[top : top + block, left : left + block] == candidates.region[i])
        nearest = ((down + 0.5 - block / 2) ** 2 + (across + 0.5 - block / 2) ** 2).argmin()
        rows[i], cols[i] = top + down[nearest], left + across[nearest]
    return np.stack([cols + 0.5, rows + 0.5], -1)
