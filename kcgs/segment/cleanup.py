"""Turning raw label maps into few, clean, connected regions."""

import heapq
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcgs._check import as_image, check_count, check_labels
from kcgs.functional.labels import compact
from kcgs.functional.merging import Labels, RegionGraph, merge_nearest

# By how much values may pass [0, 1], as resizing and colour conversion leave them.
_TOLERANCE = 1e-3
_BLOCK = 1 << 16  # pixels that change their colour space at a time

Colors = NDArray[np.float64]


def connected_regions(labels: Tensor) -> Tensor:
    """Split a label map so that every region is one piece, its pixels touching along their sides.

    Args:
        labels: :math:`(H, W)` integer, any non-negative ids.

    Returns:
        :math:`(H, W)` int64 with ids 0 to R - 1 in raster order of each piece's first pixel.

    Raises:
        TypeError, ValueError: ``labels`` is no integer map (H, W) of non-negative ids, or is empty.

    Example:
        >>> connected_regions(torch.tensor([[5, 2, 5], [5, 2, 2]])).tolist()
        [[0, 1, 2], [0, 1, 1]]
    """
    labels = check_labels("labels", labels, dims=(2,))
    return torch.from_numpy(_components(to_regions(labels)[1])).to(labels.device)


def order_by_area(labels: Tensor) -> Tensor:
    """Renumber regions by decreasing area; of equal ones, the one with the earlier first pixel comes first.

    Takes, returns and raises what :func:`connected_regions` does.

    Example:
        >>> order_by_area(torch.tensor([[9, 4, 4], [9, 4, 7]])).tolist()
        [[1, 0, 0], [1, 0, 2]]
    """
    labels = check_labels("labels", labels, dims=(2,))
    _, regions = to_regions(labels)
    areas = np.bincount(regions.ravel())
    first = np.empty_like(areas)
    first[regions.ravel()[::-1]] = np.arange(regions.size)[::-1]  # Of repeated indices the last one counts.
    rank = np.empty_like(areas)
    rank[np.lexsort((first, -areas))] = np.arange(len(areas))
    return torch.from_numpy(rank[regions]).to(labels.device)


def merge_small(labels: Tensor, min_size: int) -> Tensor:
    """Give every 4-connected piece under ``min_size`` pixels to the neighbour it has most border with.

    The smallest piece goes first, and a piece that reaches ``min_size`` by merging stays. Of neighbours with equal
    borders the larger takes it, then the one whose first pixel comes earlier.

    Args:
        labels: :math:`(H, W)` integer, any non-negative ids.
        min_size: pixels a piece must have to stay, at least 1.

    Returns:
        :math:`(H, W)` int64; remaining pieces keep their ids.

    Raises:
        TypeError, ValueError: as `connected_regions`; ``min_size`` is no integer of at least 1.

    Example:
        >>> merge_small(torch.tensor([[3, 3, 3, 8], [3, 1, 3, 8]]), min_size=2).tolist()
        [[3, 3, 3, 8], [3, 3, 3, 8]]
    """
    labels = check_labels("labels", labels, dims=(2,))
    ids, regions = to_regions(labels)
    check_count("min_size", min_size)
    pieces = _components(regions)
    graph = RegionGraph(pieces)
    queue = [(int(area), piece) for piece, area in enumerate(graph.areas) if area < min_size]
    heapq.heapify(queue)
    while queue:
        area, piece = heapq.heappop(queue)
        borders = graph.borders[piece]
        if area != graph.areas[piece] or not borders:  # an entry of before a merge
            continue
        target = max(borders, key=lambda other: (borders[other], graph.areas[other], -other))
        graph.merge(piece, target)
        if graph.areas[target] < min_size:
            heapq.heappush(queue, (int(graph.areas[target]), target))
    region_of_piece = np.empty(len(graph.areas), dtype=np.int64)
    region_of_piece[pieces.ravel()] = regions.ravel()
    return torch.from_numpy(ids[region_of_piece[graph.roots()]][pieces]).to(labels.device)


def merge_similar(image: Any, labels: Tensor, max_regions: int | None) -> Tensor:
    """Merge the two adjacent regions nearest in mean colour until at most ``max_regions`` are left.

    Colours are compared as CIE Lab (D65); a merged region has the mean of all its pixels.

    Args:
        image: :math:`(3, H, W)` or :math:`(1, H, W)` floating in [0, 1].
        labels: :math:`(H, W)` integer, any non-negative ids.
        max_regions: how many regions may stay, at least 1; None: all.

    Returns:
        :math:`(H, W)` int64; a merged region has the id of its largest part.

    Raises:
        TypeError, ValueError: as `connected_regions`; ``image`` is none, of another size, or a number out of its range.

    Example:
        >>> image = torch.tensor([[[0.0, 0.1, 0.9]]])
        >>> merge_similar(image, torch.tensor([[4, 5, 6]]), max_regions=2).tolist()
        [[4, 4, 6]]
    """
    labels = check_labels("labels", labels, dims=(2,))
    if max_regions is None:
        return labels
    check_count("max_regions", max_regions)
    lab, ids, regions = lab_and_regions(image, labels)
    graph = RegionGraph(regions)
    merge_nearest(graph, lab_sums(lab, regions), max_regions)
    return torch.from_numpy(ids[graph.roots()][regions]).to(labels.device)


def clean(labels: Tensor, min_size: int) -> Tensor:
    """Return 4-connected regions of at least ``min_size`` pixels, by decreasing area."""
    # Pieces of one region become one piece where what lay between them joins it: connect after merging.
    return order_by_area(connected_regions(merge_small(labels, min_size)))


def to_pixels(image: Tensor) -> NDArray[np.float32]:
    """Return a checked image as (H, W, 3)."""
    return image.permute(1, 2, 0).cpu().numpy()


def rgb_to_lab(image: Tensor) -> NDArray[np.float32]:
    """Return a checked image (3, H, W) as CIE Lab (D65), (H, W, 3) with L in [0, 100]."""
    from skimage.color import rgb2lab

    pixels = to_pixels(image)
    lab = np.empty(pixels.shape, dtype=np.float32)
    rows = max(1, _BLOCK // pixels.shape[1])  # its intermediates are six images
    for top in range(0, len(pixels), rows):
        lab[top : top + rows] = rgb2lab(pixels[top : top + rows])
    return lab


def lab_sums(lab: NDArray[np.float32], regions: Labels) -> Colors:
    """Return (R, 3), the colours of every region's pixels added up."""
    flat = regions.ravel()
    return np.stack([np.bincount(flat, weights=lab[..., k].ravel()) for k in range(3)], axis=1)


def _components(regions: Labels) -> Labels:
    """Return the 4-connected pieces, numbered from 0 in raster order."""
    from skimage.measure import label

    return np.asarray(label(regions, background=-1, connectivity=1), dtype=np.int64) - 1


def to_regions(labels: Tensor) -> tuple[Labels, Labels]:
    """Return the ids of a checked label map, sorted, and the position of every pixel's id among them, (H, W)."""
    ids, index, _ = compact(check_labels("labels", labels, dims=(2,)).cpu())
    return ids.numpy(), index.numpy().astype(np.int64)


def check_segment_image(image: Any) -> Tensor:
    """Return a checked image as (3, H, W) float32 in [0, 1], grey repeated, in memory pixel by pixel."""
    tensor = as_image("image", image, tolerance=_TOLERANCE).detach()
    if tensor.shape[0] not in (1, 3):
        raise ValueError(f"image must have shape (3, H, W) or (1, H, W); got {tuple(tensor.shape)}")
    return tensor.float().clamp(0, 1).expand(3, -1, -1).permute(1, 2, 0).contiguous().permute(2, 0, 1)


def lab_and_regions(image: Any, labels: Tensor) -> tuple[NDArray[np.float32], Labels, Labels]:
    """Return a checked image as CIE Lab (H, W, 3), and a checked label map of its size as `to_regions` does."""
    image, (ids, regions) = check_segment_image(image), to_regions(labels)
    if image.shape[1:] != regions.shape:
        raise ValueError(f"labels must have the image's size; got {regions.shape} and {tuple(image.shape[1:])}")
    return rgb_to_lab(image), ids, regions
