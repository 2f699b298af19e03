"""Merging regions: contours that save too little error for their length, and regions that are too many."""

from __future__ import annotations

import heapq

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcgs._check import check_labels, check_number

from .contour_fit import check_problem, contour_gain
from .labels import compact, contour_edges, unique_pairs

Labels = NDArray[np.int64]

# squared error, channels averaged, that a pixel of contour must save: what its bits save where Gaussians spend them
MERGE_COST = 0.003
# pixels on both sides of a contour whose error it bears on
_BAND = 12.0
_ROUNDS = 8


def merge_regions(image: Tensor, labels: Tensor, merge_cost: float = MERGE_COST) -> Tensor:
    """Merge regions whose contour saves less error than its bits would save if Gaussians had them.

    Convention: what a contour saves is predicted from the pixels near it: how much better two linear colours, mixed
    across the contour, explain them than one quadratic colour. The default cost is that of one to two bits per pixel of
    contour; as lossless WebP the maps of `auto` take 3.5 bits, and lose to Gaussians of as many bytes. The contours
    that save least go first, and the new map is judged again, eight times at most.

    Args:
        image: :math:`(C, H, W)` floating in [0, 1].
        labels: :math:`(H, W)` integer, non-negative.
        merge_cost: squared error that a pixel of contour must save, at least 0.

    Returns:
        :math:`(H, W)` int64; merged regions have the id of one of them; one region where no contour saves its cost.

    Raises:
        TypeError, ValueError: as :func:`kcgs.functional.choose_softness`; a negative cost.

    Example:
        >>> image = torch.zeros(3, 32, 48)
        >>> image[:, :, 16:] = 1.0
        >>> labels = (torch.arange(48) // 16).expand(32, 48)
        >>> merge_regions(image, labels)[0, ::16].tolist()
        [0, 1, 1]
    """
    check_number("merge_cost", merge_cost, 0.0)
    labels = check_labels("labels", labels)
    check_problem(image, labels)
    ids, labels = torch.unique(labels, return_inverse=True)
    for _ in range(_ROUNDS):
        gains = contour_gain(image, labels)
        saved = {pair: _BAND * (gain.smooth - gain.soft) for pair, gain in gains.items()}
        costly = sorted((value, pair) for pair, value in saved.items() if value < merge_cost)
        if not costly:
            break
        # a region merges once per round, so that what it has become is judged before it merges again
        into = torch.arange(int(labels.max()) + 1, device=labels.device)
        taken: set[int] = set()
        for _value, (a, b) in costly:
            if not taken & {a, b}:
                into[b] = a
                taken |= {a, b}
        labels = into[labels]
    merged: Tensor = ids[labels].long()
    return merged


def pairs_to_merge(image: Tensor, labels: Tensor, max_regions: int) -> list[tuple[int, int]]:
    """Find which regions to merge so that at most `max_regions` are left, as pairs of ids for `RegionMap.merge`.

    The two neighbours merge, again and again, that raise the squared error of flat colours least (Ward's method).

    Example:
        >>> labels = torch.tensor([[4, 5, 6, 6]])
        >>> pairs_to_merge(torch.tensor([[[0.0, 0.1, 0.9, 0.9]]]), labels, 2)
        [(5, 4)]
    """
    ids, index, _ = compact(labels.cpu())
    graph = RegionGraph(index.numpy().astype(np.int64))
    flat = index.flatten().numpy()
    colors = image.detach().cpu().double().flatten(1).numpy()
    sums = np.stack([np.bincount(flat, channel) for channel in colors], 1).astype(np.float64)
    merge_nearest(graph, sums, max_regions, by_error=True)
    return [(int(ids[a]), int(ids[b])) for a, b in enumerate(graph.roots()) if a != b]


class RegionGraph:
    """Which of the regions 0 to R - 1 touch and along how many pixel sides, kept up to date while regions merge."""

    def __init__(self, labels: Labels) -> None:
        """Count areas and shared sides."""
        self.areas: Labels = np.bincount(labels.ravel())
        self.borders: list[dict[int, int]] = [{} for _ in self.areas]
        self._parents = np.arange(len(self.areas))
        pairs, _, lengths = unique_pairs(contour_edges(torch.from_numpy(labels))[0])
        for (a, b), length in zip(pairs.tolist(), lengths.tolist(), strict=True):
            self.borders[a][b] = self.borders[b][a] = length

    def merge(self, source: int, target: int) -> None:
        """Let ``target`` take in its neighbour ``source``."""
        self._parents[source] = target
        self.areas[target] += self.areas[source]
        for other, length in self.borders[source].items():
            del self.borders[other][source]
            if other != target:
                self.borders[target][other] = self.borders[target].get(other, 0) + length
                self.borders[other][target] = self.borders[target][other]
        self.borders[source] = {}

    def roots(self) -> Labels:
        """Return for every region the one it is part of now."""
        roots = self._parents
        while (roots != roots[roots]).any():
            roots = roots[roots]
        return roots


def merge_nearest(graph: RegionGraph, sums: NDArray[np.float64], max_regions: int, by_error: bool = False) -> None:
    """Merge the nearest pair of neighbours while there are too many regions; `sums` holds colours times areas, (R, C).

    Near is a small distance between mean colours, or with `by_error` a small rise of the squared error of flat colours.
    """

    def distance(a: int, b: int) -> float:
        one, other = graph.areas[a], graph.areas[b]
        difference = float(np.linalg.norm(sums[a] / one - sums[b] / other))
        return difference**2 * float(one * other / (one + other)) if by_error else difference

    # Distances change with every merge; entries of before one are told by the regions' borders and areas.
    queue = [
        (distance(a, b), a, b, graph.areas[a], graph.areas[b])
        for a, others in enumerate(graph.borders)
        for b in others
        if a < b
    ]
    heapq.heapify(queue)
    count = len(graph.areas)
    while count > max_regions:
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
