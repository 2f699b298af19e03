"""Label maps as tensors: ids under centres, edges between regions, the band along contours, resampling."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np
import torch
from torch import Tensor

from kcgs._check import check_floating, check_number
from kcgs._labels import check_labels
from kcgs._rows import row_slices
from kcgs.errors import InvalidArgument

_PIXELS = 1 << 18  # per slice of a map whose pairs are listed; it bounds the memory for maps of noise
_TABLE_IDS = 1 << 16  # up to this id a table is ten times faster than sorting every pixel


def lookup_regions(means: Tensor, labels: Tensor) -> Tensor:
    r"""Read the region under each centre: labels[floor(y), floor(x)], clamped to the image.

    Args:
        means: centres (x, y) in pixels, :math:`(N, 2)` or :math:`(B, N, 2)`.
        labels: integer label map, :math:`(H, W)`, or :math:`(B, H, W)` with one map for each batch of centres.

    Returns:
        Ids, int64, :math:`(N,)` or :math:`(B, N)`.

    Raises:
        TypeError, ValueError: wrong dtype; wrong shapes, values that are not finite, negative ids.

    Example:
        >>> lookup_regions(torch.tensor([[0.2, 0.9], [5.0, -3.0]]), torch.tensor([[1, 2], [3, 4]]))
        tensor([1, 2])

    Source: the paper's region assignment.
    """
    means = check_floating("means", means, last=2, dims=(2, 3))
    labels = check_labels("labels", labels)
    if labels.ndim == 3 and (means.ndim != 3 or means.shape[0] != labels.shape[0]):
        raise ValueError(
            f"labels of shape {tuple(labels.shape)} need means of shape ({labels.shape[0]}, N, 2); got "
            f"{tuple(means.shape)}"
        )
    y, x = pixels_under(means, labels.shape[-2:])
    if labels.ndim == 2:
        return labels[y, x]
    return labels.flatten(1).gather(1, y * labels.shape[-1] + x)


def pixels_under(means: Tensor, size: Sequence[int]) -> tuple[Tensor, Tensor]:
    """Return row and column of the pixel under each centre, clamped to an image (height, width)."""
    height, width = size
    pixel = means.detach().floor()
    return pixel[..., 1].clamp(0, height - 1).long(), pixel[..., 0].clamp(0, width - 1).long()


def edge_band(labels: Tensor, width: float = 5) -> Tensor:
    r"""Mark the pixels near a contour: those whose distance to a pixel of another label is at most `width`.

    Convention: Euclidean distance between pixel centres, so that a pixel beside a change has distance 1. The band
    lies on both sides of the contour.

    Args:
        labels: integer label map, :math:`(H, W)` or :math:`(B, H, W)`.
        width: in pixels, at least 1.

    Returns:
        Boolean, shape of `labels`; all False where there is one region.

    Raises:
        TypeError, ValueError: labels are not integer; wrong shape, negative ids, width below 1 or not finite.

    Example:
        >>> edge_band(torch.tensor([[0, 0, 0, 0, 9, 9]]), width=2).int()
        tensor([[0, 0, 1, 1, 1, 1]], dtype=torch.int32)

    Source: the paper's edge-focused evaluation (5 pixels inward and outward).
    """
    labels = check_labels("labels", labels)
    check_number("width", width, 1.0, unit="pixels")
    height, breadth = labels.shape[-2:]
    band = torch.zeros_like(labels, dtype=torch.uint8)  # not bool: inductor's C++ for slices of bool does not compile
    width = min(width, math.hypot(height, breadth))
    for dy in range(min(int(width), height - 1) + 1):
        reach = min(int(math.sqrt(width * width - dy * dy)), breadth - 1)
        for dx in range(-reach if dy else 1, reach + 1):
            first = (..., slice(0, height - dy), slice(max(0, -dx), breadth - max(0, dx)))
            second = (..., slice(dy, height), slice(max(0, dx), breadth - max(0, -dx)))
            differs = (labels[first] != labels[second]).byte()
            band[first] |= differs
            band[second] |= differs
    return band.bool()


def contour_edges(labels: Tensor) -> tuple[Tensor, Tensor]:
    r"""List the pixel sides at which the label changes.

    Args:
        labels: integer label map, :math:`(H, W)`.

    Returns:
        The two ids at each side, the lower first, :math:`(E, 2)`; and row and column of the pixel left of the side or
        above it, :math:`(E, 2)`. Sides between columns come first, then sides between rows, each in raster order.

    Example:
        >>> contour_edges(torch.tensor([[5, 5, 2]]))
        (tensor([[2, 5]]), tensor([[0, 1]]))
    """
    height, width = labels.shape
    pairs, places = [], []
    for dy, dx in ((0, 1), (1, 0)):
        first, second = labels[: height - dy, : width - dx], labels[dy:, dx:]
        place = (first != second).nonzero()
        rows, columns = place.unbind(1)
        ends = torch.stack([first[rows, columns], second[rows, columns]], 1)
        pairs.append(torch.cat([ends.amin(1, True), ends.amax(1, True)], 1))
        places.append(place)
    return torch.cat(pairs), torch.cat(places)


def touching_pairs(labels: Tensor) -> set[tuple[int, int]]:
    r"""Find the pairs of regions, the lower id first, that share a pixel side in a map, or in any of a batch.

    Example:
        >>> touching_pairs(torch.tensor([[0, 3, 3], [0, 0, 7]])) == {(0, 3), (0, 7), (3, 7)}
        True
    """
    if labels.ndim == 3:
        return set().union(*map(touching_pairs, labels))
    pairs: set[tuple[int, int]] = set()
    for rows in row_slices(labels.shape[0], labels.shape[1], _PIXELS):
        edges = contour_edges(labels[rows.start : rows.stop + 1])[0]  # with the row below
        pairs |= {(low, high) for low, high in unique_pairs(edges)[0].tolist()}
    return pairs


def unique_pairs(pairs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the distinct rows of (E, 2), in order; the place of each row among them, (E,); and the count of each.

    The result equals that of `unique(dim=0)`, which compares row by row and is 20 times slower.
    """
    ids, ends = pairs.unique(return_inverse=True)
    base = max(1, len(ids))
    codes, place, counts = (ends[:, 0] * base + ends[:, 1]).unique(return_inverse=True, return_counts=True)
    return ids[torch.stack([codes // base, codes % base], 1)], place, counts


def union_find(ids: Iterable[int], pairs: Iterable[tuple[int, int]]) -> Callable[[int], int]:
    """Merge pairs of ids; return a function from an id to the least id that it is merged with."""
    root = {region: region for region in ids}

    def find(region: int) -> int:
        if region not in root:
            raise InvalidArgument("pairs", "ids of the map", region, verb="hold")
        while root[region] != region:
            region = root[region]
        return region

    for a, b in pairs:
        low, high = sorted((find(a), find(b)))
        root[high] = low
    return find


def compact(labels: Tensor) -> tuple[Tensor, Tensor]:
    """Return the sorted ids, and each pixel's position among them, int32; the host waits once for other devices."""
    if labels.device.type == "cpu":
        from .loops import number_regions  # loads numba

        index = np.empty(labels.shape, np.int32)
        ids = number_regions(labels.contiguous().numpy().ravel(), _TABLE_IDS, index.ravel())
        if len(ids):
            return torch.from_numpy(ids), torch.from_numpy(index)
        ids = labels.unique_consecutive().unique()  # without an inverse, which would be an int64 index of the pixels
    else:
        ids = labels.unique()
    return ids, torch.searchsorted(ids, labels.contiguous(), out_int32=True)


def positions_of(region_ids: Tensor, ids: Tensor) -> Tensor:
    """Return the position of each id among sorted `ids`, int64, -1 where it is not one of them."""
    if ids.device.type == "cpu" and not torch.compiler.is_compiling():
        from .loops import find_positions  # loads numba; its loop wakes no threads of torch, which would spin beside it

        positions = np.empty(region_ids.shape, np.int64)
        find_positions(region_ids.long().contiguous().numpy().ravel(), ids.numpy(), _TABLE_IDS, positions.ravel())
        return torch.from_numpy(positions)
    places = torch.searchsorted(ids, region_ids.contiguous()).clamp_max(len(ids) - 1)
    return torch.where(ids[places] == region_ids, places, -1)


def nearest_labels(labels: Tensor, hole: Tensor) -> Tensor:
    r"""Give pixels of the hole, :math:`(H, W)` bool, the label of the nearest other pixel.

    Example:
        >>> nearest_labels(torch.tensor([[7, 0, 0, 3]]), torch.tensor([[False, True, True, False]]))
        tensor([[7, 7, 3, 3]])
    """
    from .nearest import spread  # loads numba

    ids, index = compact(labels.cpu())
    values = index.masked_fill(hole.cpu(), -1)[None]
    spread(values.numpy(), index[None].numpy())
    return ids[index.long()].to(labels.device)


def sample_labels(labels: Tensor, height: int, width: int) -> Tensor:
    """Sample a label map at another size: a new pixel has the label of the old pixel in which its centre lies."""
    for dim, new in ((-2, height), (-1, width)):
        places = (2 * torch.arange(new, device=labels.device) + 1) * labels.shape[dim] // (2 * new)
        labels = labels.index_select(dim, places)
    return labels
