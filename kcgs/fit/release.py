"""Which contours help: a short trial with and without them."""

from __future__ import annotations

import copy
import math
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from kcgs.functional import RegionMap

from .colors import solve_colors

if TYPE_CHECKING:
    from .session import Session

# steps of each trial, as a share of the fit so far
_TRIAL = 0.05
_SOLVE_STEPS = 8
# share of the error that must be saved: contours stay unless they plainly harm, for they are sharp where it shows
_MARGIN = 0.25
# steps of the fits that are compared at the start
_REHEARSAL = 20
# pixels about a contour in which its help is measured
_REACH = 12.0


def release(session: Session) -> None:
    """Unite the touching regions that are drawn better without the contour between them.

    The fit goes on for some steps twice from the same state, with all contours and with none, both after a solution of
    the colours, since Gaussians that were confined overlap once they are not. The squared errors of the two pictures
    are summed over the pixels nearest to each pair's contour; where none is better by a quarter the pair is united.
    """
    drawn, ids, kept = session.drawn, session.ids, session.state()
    assert drawn is not None and ids is not None
    kept = copy.deepcopy({name: kept[name] for name in ("descent", "iteration")})
    steps = max(5, round(_TRIAL * session.iteration))
    with_contours = _trial(session, steps)
    _restore(session, kept, ids, drawn)
    session.ids = session.drawn = None
    without = _trial(session, steps)
    _restore(session, kept, ids, drawn)
    pairs = _harmful_pairs(drawn.labels, with_contours, without)
    if pairs:
        session.drawn, session.ids = merge_pairs(drawn, ids, pairs)
        session.anchor = _united(drawn, pairs)[drawn.index_of(session.anchor)]
        _solve(session)


def choose_contours(session: Session) -> RegionMap | None:
    """Leave out, before the fit, the contours that are no help from the start.

    Two short fits, one with all contours and one with none, start anew with the few Gaussians that growth starts from;
    they are compared as in :func:`release`, which cannot see this: what confined Gaussians have learnt by then is
    little use to unconfined ones. The session is left at the start of the fit, with the map that is returned.
    """
    drawn = session.drawn
    assert drawn is not None
    errors = []
    for regions in (drawn, None):
        session.begin(regions)
        errors.append(_error_after(session, _REHEARSAL))
    chosen, _ = merge_pairs(drawn, drawn.ids, _harmful_pairs(drawn.labels, *errors))
    session.begin(chosen)
    return chosen


def _trial(session: Session, steps: int) -> Tensor:
    _solve(session)
    return _error_after(session, steps)


def _error_after(session: Session, steps: int) -> Tensor:
    """Squared error of each pixel after some steps; infinite where they diverge."""
    progress = session.progress()
    for _ in range(steps):
        session.step(session.draw(), progress)
        if not session.descent.is_finite():
            return torch.full(session.size, math.inf, device=session.image.device)
    with torch.no_grad():
        return session.error()


def _solve(session: Session) -> None:
    field = session.gaussians().field(session.size)
    settings = {"cutoff": session.cutoff, "backend": session.config.backend}
    solved = solve_colors(field, session.image, session.drawn, steps=_SOLVE_STEPS, **settings)  # type: ignore[arg-type]
    session.descent.recolor(solved.colors.detach())


def _restore(session: Session, kept: dict[str, Any], ids: Tensor, drawn: RegionMap) -> None:
    session.ids, session.drawn, session.iteration = ids, drawn, kept["iteration"]
    session.descent.load(copy.deepcopy(kept["descent"]))


def _harmful_pairs(labels: Tensor, with_contours: Tensor, without: Tensor) -> list[tuple[int, int]]:
    """Pairs without whose contour the error is plainly less; two regions share all pixels of the image."""
    if not bool(torch.isfinite(with_contours + without).all()):
        return []  # a trial that diverged tells nothing
    difference = without - (1 - _MARGIN) * with_contours
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
    from scipy import ndimage

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
    if not pairs:
        return regions, ids
    new = _united(regions, pairs)
    if len(torch.unique(new)) == 1:
        return None, None
    labels = new[regions.index_of(regions.labels)]
    return RegionMap.from_labels(labels, _united_widths(regions, new)), new[regions.index_of(ids)]


def _united(regions: RegionMap, pairs: list[tuple[int, int]]) -> Tensor:
    """New id of each region: the least of those it is united with."""
    root = {int(i): int(i) for i in regions.ids}

    def find(i: int) -> int:
        while root[i] != i:
            i = root[i]
        return i

    for a, b in pairs:
        low, high = sorted((find(a), find(b)))
        root[high] = low
    return torch.tensor([find(int(i)) for i in regions.ids], device=regions.ids.device)


def _united_widths(regions: RegionMap, new: Tensor) -> float | dict[tuple[int, int], float]:
    """Width of each pair of united regions: the mean of what was united."""
    if isinstance(regions.softness, float):
        return regions.softness
    root = dict(zip(regions.ids.tolist(), new.tolist(), strict=True))
    widths: dict[tuple[int, int], list[float]] = {}
    for (a, b), width in regions.softness.items():
        low, high = sorted((root[a], root[b]))
        if low != high:
            widths.setdefault((low, high), []).append(width)
    return {pair: sum(found) / len(found) for pair, found in widths.items()}
