"""The regions of a map as a graph: their areas and borders, and the merging of neighbours."""

from __future__ import annotations

import heapq

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .labels import compact, contour_edges, unique_pairs

Labels = NDArray[np.int64]


def pairs_to_merge(image: Tensor, labels: Tensor, max_regions: int) -> list[tuple[int, int]]:
    """Return pairs of ids for `RegionMap.merge`, so that at most `max_regions` remain.

    The two neighbours that raise the squared error of flat colours least merge first (Ward's method).

    Example:
        >>> labels = torch.tensor([[4, 5, 6, 6]])
        >>> pairs_to_merge(torch.tensor([[[0.0, 0.1, 0.9, 0.9]]]), labels, 2)
        [(5, 4)]
    """
    ids, index = compact(labels.cpu())
    graph = RegionGraph(index.numpy().astype(np.int64))
    flat = index.flatten().numpy()
    colors = image.detach().cpu().double().flatten(1).numpy()
    sums = np.stack([np.bincount(flat, channel) for channel in colors], 1).astype(np.float64)
    merge_nearest(graph, sums, max_regions, by_error=True)
    return [(int(ids[a]), int(ids[b])) for a, b in enumerate(graph.roots()) if a != b]


class RegionGraph:
    """The regions 0 to R - 1: their areas, and the number of pixel sides that two share; regions merge in place.

    `objects` is a second map whose contours no region crosses; regions of different objects are no neighbours.
    """

    def __init__(self, labels: Labels, objects: Labels | None = None) -> None:
        """Count areas and shared sides."""
        self.areas: Labels = np.bincount(labels.ravel())
        self.borders: list[dict[int, int]] = [{} for _ in self.areas]
        self._parents = np.arange(len(self.areas))
        pairs, _, lengths = unique_pairs(contour_edges(torch.from_numpy(labels))[0])
        owners = np.zeros(len(self.areas), np.int64)
        if objects is not None:
            owners[labels] = objects
        for (a, b), length in zip(pairs.tolist(), lengths.tolist(), strict=True):
            if owners[a] == owners[b]:
                self.borders[a][b] = self.borders[b][a] = length

    def merge(self, source: int, target: int) -> None:
        """Add ``source`` to its neighbour ``target``."""
        self._parents[source] = target
        self.areas[target] += self.areas[source]
        for other, length in self.borders[source].items():
            del self.borders[other][source]
            if other != target:
                self.borders[target][other] = self.borders[target].get(other, 0) + length
                self.borders[other][target] = self.borders[target][other]
        self.borders[source] = {}

    def roots(self) -> Labels:
        """Return for every region the region that it is now part of."""
        roots = self._parents
        while (roots != roots[roots]).any():
            roots = roots[roots]
        return roots


def merge_nearest(graph: RegionGraph, sums: NDArray[np.float64], max_regions: int, by_error: bool = False) -> None:
    """Merge the nearest neighbours while there are too many regions; `sums` holds colours times areas, (R, C).

    The distance of two regions is that of their mean colours; with `by_error`, the rise of the squared error of flat
    colours.
    """

    def distance(a: int, b: int) -> float:
        area_a, area_b = graph.areas[a], graph.areas[b]
        difference = float(np.linalg.norm(sums[a] / area_a - sums[b] / area_b))
        return difference**2 * float(area_a * area_b / (area_a + area_b)) if by_error else difference

    # Distances change with every merge; an entry is out of date where borders or areas differ.
    queue = [
        (distance(a, b), a, b, graph.areas[a], graph.areas[b])
        for a, others in enumerate(graph.borders)
        for b in others
        if a < b
    ]
    heapq.heapify(queue)
    count = len(graph.areas)
    while count > max_regions and queue:
        _, a, b, area_a, area_b = heapq.heappop(queue)
        if b not in graph.borders[a] or (area_a, area_b) != (graph.areas[a], graph.areas[b]):
            continue
        source, target = (a, b) if area_a < area_b else (b, a)
        graph.merge(source, target)
        sums[target] += sums[source]
        count -= 1
        for other in graph.borders[target]:
            low, high = min(target, other), max(target, other)
            heapq.heappush(queue, (distance(low, high), low, high, graph.areas[low], graph.areas[high]))
