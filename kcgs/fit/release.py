"""Which contours help: a short trial with and without them."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from scipy import ndimage
from torch import Tensor

from kcgs.functional import RegionMap

if TYPE_CHECKING:
    from .session import Session

# steps of each trial, as a share of the fit so far
_TRIAL = 0.05
# pixels about a contour in which its help is measured
_REACH = 12.0


def helpless_pairs(session: Session) -> list[tuple[int, int]]:
    """Find the pairs of touching regions that are drawn better without the contour between them.

    The fit goes on for some steps twice from the same state, with all contours and with none; the squared errors of
    the two pictures are summed over the pixels nearest to each pair's contour. The session is left as it was.

    Returns:
        Pairs (a, b) of region ids, a < b.
    """
    kept = session.ids, session.drawn, session.iteration, copy.deepcopy(session.descent.state())
    drawn, steps = session.drawn, max(5, round(_TRIAL * session.iteration))
    assert drawn is not None
    with_contours = _trial(session, steps)
    _restore(session, kept)
    session.ids = session.drawn = None
    without = _trial(session, steps)
    _restore(session, kept)
    return _pairs_below(drawn.labels, without - with_contours)


def _trial(session: Session, steps: int) -> Tensor:
    for _ in range(steps):
        session.step(session.draw(), session.progress())
    with torch.no_grad():
        return (session.draw() - session.image).square().mean(0)


def _restore(session: Session, kept: tuple[object, ...]) -> None:
    session.ids, session.drawn, session.iteration = kept[:3]  # type: ignore[assignment]
    session.descent.load(copy.deepcopy(kept[3]))  # type: ignore[arg-type]


def _pairs_below(labels: Tensor, difference: Tensor) -> list[tuple[int, int]]:
    """Pairs whose pixels sum to less than zero; two regions share all pixels of the image."""
    ids = torch.unique(labels)
    if len(ids) == 2:
        return [(int(ids[0]), int(ids[1]))] if float(difference.sum()) < 0 else []
    own, other, distance = nearest_contour(labels)
    near = distance <= _REACH
    low, high = torch.minimum(own, other)[near], torch.maximum(own, other)[near]
    pairs, index = torch.unique(torch.stack([low, high], -1), dim=0, return_inverse=True)
    sums = torch.zeros(len(pairs), dtype=difference.dtype).index_add_(0, index, difference.cpu()[near])
    return [(int(a), int(b)) for (a, b), total in zip(pairs.tolist(), sums.tolist(), strict=True) if total < 0]


def nearest_contour(labels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """For every pixel: its label, the label on the other side of the nearest contour, and the distance in pixels."""
    labels = labels.cpu()
    other = labels.clone()
    for dim in (0, 1):
        for shift in (1, -1):
            moved = labels.roll(shift, dim)
            edge = 0 if shift == 1 else labels.shape[dim] - 1
            moved.select(dim, edge).copy_(labels.select(dim, edge))
            other = torch.where(other == labels, moved, other)
    distance, (row, column) = ndimage.distance_transform_edt((other == labels).numpy(), return_indices=True)
    at = torch.from_numpy(row).long(), torch.from_numpy(column).long()
    across = torch.where(labels[at] == labels, other[at], labels[at])
    return labels, across, torch.from_numpy(distance)


def merge_pairs(
    regions: RegionMap, ids: Tensor, pairs: list[tuple[int, int]]
) -> tuple[RegionMap | None, Tensor | None]:
    """Unite regions; where one remains there is no map any more.

    Args:
        regions: the map.
        ids: of the Gaussians, (N,).
        pairs: ids to unite.
    """
    root = {int(i): int(i) for i in regions.ids}

    def find(i: int) -> int:
        while root[i] != i:
            i = root[i]
        return i

    for a, b in pairs:
        low, high = sorted((find(a), find(b)))
        root[high] = low
    new = torch.tensor([find(int(i)) for i in regions.ids], device=ids.device)
    if len(torch.unique(new)) == 1:
        return None, None
    if not pairs:
        return regions, ids
    labels = new[regions.index_of(regions.labels)]
    return RegionMap.from_labels(labels, _united_widths(regions, find)), new[regions.index_of(ids)]


def _united_widths(regions: RegionMap, find: Callable[[int], int]) -> float | dict[tuple[int, int], float]:
    softness = regions.softness
    if isinstance(softness, float):
        return softness
    widths: dict[tuple[int, int], list[float]] = {}
    for (a, b), width in softness.items():
        low, high = sorted((find(a), find(b)))
        if low != high:
            widths.setdefault((low, high), []).append(width)
    return {pair: sum(found) / len(found) for pair, found in widths.items()}
