"""Polygons on a pixel grid: exact coverage with gradients, and label maps."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from kcgs._check import check_count, check_floating, check_size
from kcgs.kernels.tiles import expand_runs

_MOST_LABELS = 16384  # along a side, times the supersample


def polygon_coverage(polygons: Tensor | Sequence[Tensor], size: tuple[int, int]) -> Tensor:
    r"""Give the share of every pixel's area that each polygon covers, exactly, differentiable in the vertices.

    Each edge adds the signed area between itself and the right border of its pixels; the sum round a polygon is
    the area inside. Time and memory grow with the length of the outlines, not with the area.

    Convention: vertices (x, y) in pixels, pixel (j, i) covering [j, j + 1] x [i, i + 1]; either orientation; the last
    vertex joins the first. Polygons may leave the image, and overlap each other. One that crosses itself counts an
    area once for each turn round it, minus for turns against its orientation. A hole: subtract the hole's coverage.
    The gradient is that of the area; it jumps where a vertex or an edge lies exactly on the grid. Half precision is
    computed in float32.

    Args:
        polygons: R polygons, :math:`(V, 2)` each with 3 vertices or more, as a sequence, or as :math:`(R, V, 2)`.
        size: (height, width).

    Returns:
        :math:`(R, H, W)` in the dtype of the vertices, in [0, 1] up to rounding.

    Raises:
        TypeError: vertices are no floating tensors, size no pair of integers.
        ValueError: no polygon, wrong shapes, fewer than 3 vertices, different dtypes or devices, values not finite.

    Example:
        >>> triangle = torch.tensor([[0.0, 0.0], [4.0, 0.0], [0.0, 2.0]])
        >>> polygon_coverage([triangle], (2, 4))
        tensor([[[1.0000, 1.0000, 0.7500, 0.2500],
                 [0.7500, 0.2500, 0.0000, 0.0000]]])
    """
    outlines = _check_polygons(polygons)
    height, width = check_size("size", size)
    dtype = outlines[0].dtype
    working = dtype if dtype == torch.float64 else torch.float32
    return torch.stack([_coverage(outline.to(working), height, width) for outline in outlines]).to(dtype)


def polygon_labels(polygons: Tensor | Sequence[Tensor], size: tuple[int, int], supersample: int = 1) -> Tensor:
    r"""Rasterise polygons into a label map: 0 where there is none, 1 to R for the polygons, the later over the earlier.

    A label is that of its pixel's centre; centres on an outline belong to it, so that polygons with a common edge leave
    no gap. With ``supersample`` the map is what :meth:`RegionMap.from_labels` takes with the same number. Not
    differentiable. Where a polygon crosses itself, what it winds round twice is outside.

    Args:
        polygons: R polygons, as for :func:`polygon_coverage`.
        size: (height, width) in pixels.
        supersample: labels along a side of a pixel, k, at least 1.

    Returns:
        int64, :math:`(kH, kW)`, on the device of the polygons.

    Raises:
        TypeError: vertices are no floating tensors, size or supersample no integers.
        ValueError: as :func:`polygon_coverage`; supersample below 1, or a map of more than 16384 labels a side.

    Example:
        >>> from kcgs import RegionMap
        >>> triangle = torch.tensor([[0.0, 0.0], [4.0, 0.0], [0.0, 2.0]])
        >>> regions = RegionMap.from_labels(polygon_labels([triangle], (2, 4), 8), supersample=8)
        >>> regions.labels
        tensor([[1, 1, 1, 0],
                [1, 0, 0, 0]])
    """
    from skimage.draw import polygon as inside

    outlines = _check_polygons(polygons)
    height, width = check_size("size", size)
    supersample = check_count("supersample", supersample)
    if max(height, width) * supersample > _MOST_LABELS:
        raise ValueError(
            f"supersample must be at most {_MOST_LABELS} / {max(height, width)} at this size; got {supersample}"
        )
    labels = torch.zeros(height * supersample, width * supersample, dtype=torch.int64)
    for number, outline in enumerate(outlines, 1):
        x, y = (outline.detach().double().cpu() * supersample - 0.5).unbind(1)
        rows, columns = inside(y.numpy(), x.numpy(), labels.shape)
        labels[torch.from_numpy(rows), torch.from_numpy(columns)] = number
    return labels.to(outlines[0].device)


def _check_polygons(polygons: Tensor | Sequence[Tensor]) -> list[Tensor]:
    if isinstance(polygons, Tensor):
        check_floating("polygons", polygons, last=2, dims=(3,))
    outlines = list(polygons)
    if not outlines:
        raise ValueError("polygons must hold at least one polygon; got none")
    for outline in outlines:
        check_floating("polygons", outline, last=2, dims=(2,))
        if len(outline) < 3:
            raise ValueError(f"polygons must have at least 3 vertices each; got shape {tuple(outline.shape)}")
        if outline.dtype != outlines[0].dtype or outline.device != outlines[0].device:
            raise ValueError(
                f"polygons must have one dtype and device; got {outlines[0].dtype} on {outlines[0].device} and "
                f"{outline.dtype} on {outline.device}"
            )
    return outlines


def _coverage(outline: Tensor, height: int, width: int) -> Tensor:
    """Return [H, W]: areas add up from the left, so only pixels that an edge meets need a number."""
    row, near, far, drop = _rows(outline, height)
    drop = drop * _orientation(outline)
    left = torch.minimum(near, far).detach().floor().clamp(0, width).long()
    right = torch.maximum(near, far).detach().floor().clamp(-1, width - 2).long() + 1
    of, step = expand_runs((right - left + 1).clamp_min(0))
    column = left[of] + step
    inside = _right_of(near[of], far[of], column)
    before = torch.where(step > 0, _right_of(near[of], far[of], column - 1), 0.0)
    added = outline.new_zeros(height * width)
    added = added.index_add(0, row[of] * width + column, drop[of] * (inside - before))
    return added.view(height, width).cumsum(1)


def _rows(outline: Tensor, height: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Cut edges into pieces of one pixel row: its row, x at both ends, and the signed height of each."""
    start, end = outline, outline.roll(-1, 0)
    turned = (start[:, 1] > end[:, 1])[:, None]
    upper, lower = torch.where(turned, end, start), torch.where(turned, start, end)
    first = upper[:, 1].detach().floor().clamp(0, height)
    last = (lower[:, 1].detach().ceil() - 1).clamp(-1, height - 1)
    # an edge on the grid line below a row is in no row by this, and has a gradient all the same
    last = torch.where(lower[:, 1].detach() < 0, last, last.maximum(first))
    of, step = expand_runs((last - first + 1).clamp_min(0).long() * (first < height))
    row = first[of] + step
    (x0, y0), (x1, y1) = upper[of].unbind(1), lower[of].unbind(1)
    tall = y1 - y0
    slope = (x1 - x0) / torch.where(tall > 0, tall, 1.0)
    # ends that lie in the row are taken as they are: a level edge has no slope, and yet a gradient
    begins, ends = y0 >= row, y1 <= row + 1
    near = torch.where(begins, x0, x0 + (row - y0) * slope)
    far = torch.where(ends, x1, x0 + (row + 1 - y0) * slope)
    drop = torch.where(ends, y1, row + 1) - torch.where(begins, y0, row)
    return row.long(), near, far, torch.where(turned[of, 0], -drop, drop)


def _right_of(near: Tensor, far: Tensor, column: Tensor) -> Tensor:
    """Return the mean share of a pixel to the right of a line whose x goes from `near` to `far`."""
    a, b = column + 1 - near, column + 1 - far
    low, high = torch.minimum(a, b), torch.maximum(a, b)
    span = high - low
    # a line this steep is upright: the quotient below would lose its digits
    upright = span < torch.finfo(span.dtype).eps ** 0.5
    inner_low, inner_high = low.clamp(0, 1), high.clamp(0, 1)
    area = (inner_high - inner_low) * (inner_high + inner_low) / 2 + (high - low.clamp_min(1)).clamp_min(0)
    return torch.where(upright, ((a + b) / 2).clamp(0, 1), area / torch.where(upright, 1.0, span))


def _orientation(outline: Tensor) -> Tensor:
    x, y = (outline.detach() - outline.detach()[0]).unbind(1)
    return torch.where((x * y.roll(-1) - x.roll(-1) * y).sum() > 0, -1.0, 1.0).to(outline.dtype)
