"""What contours cost, and smoother ones that cost less: estimates of the network alone, without a stream."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .contexts import (
    CLIP,
    COLUMNS,
    FIRST,
    INPUT,
    INPUTS,
    LEFT,
    RIGHT,
    SECOND,
    TOP,
    compiled,
    describe,
    inner,
    network,
    quiet,
)
from .labels import Labels, compact

_START, _ESCAPE = 11.0, 4.0  # bits of a start's place, of a label that is no candidate
_SWEEPS = 4
_NO_COSTS = np.zeros((0, 1, 1), np.float32)


class _Model(NamedTuple):
    cost: Any  # [2 * CLIP + 1] float64, bits of a 1 at this logit
    row: Any  # [COLUMNS] int32


class _Loops(NamedTuple):
    measure: Callable[..., float]
    sweep: Callable[..., int]


@inner
def _bits(labels, top, bottom, left, right, several, model):  # type: ignore[no-untyped-def]
    """Estimate what the pixels of a window cost."""
    total = 0.0
    for y in range(top, bottom):
        for x in range(left, right):
            label = labels[y, x]
            if quiet(labels, y, x):
                if label != labels[y, x - 1]:
                    total += _START
                continue
            describe(labels, y, x, model.row)
            network(model.row)
            neither = label != model.row[FIRST] and label != model.row[SECOND]
            if several:
                logit = model.row[INPUT + INPUTS]
                total += model.cost[CLIP + logit] + _ESCAPE if neither else model.cost[CLIP - logit]
            if not neither:
                logit = model.row[INPUT]
                total += model.cost[CLIP - logit] if label == model.row[FIRST] else model.cost[CLIP + logit]
    return total


@inner
def _stands(labels, y, x, new):  # type: ignore[no-untyped-def]
    """Tell whether a pixel is so much among its own that another label would make a bump."""
    balance = 0
    for j in range(-1, 2):
        for i in range(-1, 2):
            balance += (labels[y + j, x + i] == labels[y, x]) - (labels[y + j, x + i] == new)
    return balance > 2


@inner
def _saved(labels, y, x, new, shape, several, model):  # type: ignore[no-untyped-def]
    """Estimate the bits that a pixel's new label saves, in all pixels that see it."""
    bottom, left, right = min(y + TOP + 1, TOP + shape[0]), max(x - 8, LEFT), min(x + 9, LEFT + shape[1])
    before = _bits(labels, y, bottom, left, right, several, model)
    old = labels[y, x]
    labels[y, x] = new
    after = _bits(labels, y, bottom, left, right, several, model)
    labels[y, x] = old
    return before - after


@inner
def _price(given, costs, i, j, old, new):  # type: ignore[no-untyped-def]
    if len(costs) > 0:
        return np.float64(costs[new, i, j] - costs[old, i, j])
    return np.float64(given[i, j] == old) - np.float64(given[i, j] == new)


def _compile(fingerprint: str, cache: bool) -> _Loops:
    entry = cast(Any, njit)(cache=cache, nogil=True, no_cfunc_wrapper=True, error_model="numpy")

    @entry
    def measure(labels, top, bottom, left, right, several, model):  # type: ignore[no-untyped-def]
        """Estimate what a window of a map with margins costs."""
        fingerprint  # noqa: B018
        return _bits(labels, top, bottom, left, right, several, model)

    @entry
    def sweep(labels, given, costs, sizes, rate, keep, several, model):  # type: ignore[no-untyped-def]
        """Give pixels their neighbours' labels where that pays; return how many changed."""
        fingerprint  # noqa: B018
        changed = 0
        for y in range(TOP, TOP + given.shape[0]):
            for x in range(LEFT, LEFT + given.shape[1]):
                for side in range(4):
                    old = labels[y, x]
                    new = labels[y + (side == 1) - (side == 0), x + (side == 3) - (side == 2)]
                    if new == old or (keep and sizes[old] == 1) or _stands(labels, y, x, new):
                        continue
                    if rate * _saved(labels, y, x, new, given.shape, several, model) > _price(
                        given, costs, y - TOP, x - LEFT, old, new
                    ):
                        labels[y, x] = new
                        sizes[old] -= 1
                        sizes[new] += 1
                        changed += 1
        return changed

    return _Loops(measure, sweep)


@functools.cache
def _loops() -> _Loops:
    return compiled("the estimates of contours", _compile, _rehearse, "smooth.py")


def _rehearse(run: _Loops) -> None:
    index = np.eye(2, dtype=np.int32)
    run.measure(_frame(index), TOP, TOP + 1, LEFT, LEFT + 1, False, _model())
    run.sweep(_frame(index), index, _NO_COSTS, np.full(2, 2), 0.0, True, False, _model())


@functools.cache
def _model() -> _Model:
    cost = np.log2(1 + np.exp(-np.arange(-CLIP, CLIP + 1) / 256))
    return _Model(cost, np.zeros(COLUMNS, np.int32))


def _frame(index: Any) -> Any:
    return np.pad(index, ((TOP, 1), (LEFT, RIGHT)), mode="edge")


def contour_bits(labels: Labels) -> float:
    """Estimate the size of a map's stream in bits, without ids; an adaptive stream is a few percent smaller.

    Args:
        labels: (H, W), non-negative ids.

    Example:
        >>> contour_bits(np.zeros((32, 32), np.int64))
        0.0
    """
    ids, index = compact(labels)
    if len(ids) == 1:
        return 0.0
    height, width = labels.shape
    frame = _frame(index)
    return _loops().measure(frame, TOP, TOP + height, LEFT, LEFT + width, len(ids) > 2, _model())


def bits_without(labels: Labels, a: int, b: int) -> float:
    """Estimate the bits that a map saves when region `a` becomes part of region `b`.

    Args:
        labels: (H, W), non-negative ids.
        a: id of the region that goes.
        b: id of the region that it joins.

    Example:
        >>> bits_without(np.repeat([[1], [2]], 32, axis=0) + np.zeros((1, 64), np.int64), 1, 2) > 0
        True
    """
    ids, index = compact(labels)
    height, width = labels.shape
    frame = _frame(index)
    position = {int(region): at for at, region in enumerate(ids)}
    rows, columns = np.nonzero(index == position[a])
    top, bottom = int(rows.min()), min(int(rows.max()) + TOP + 1, height)
    left, right = max(int(columns.min()) - RIGHT, 0), min(int(columns.max()) + LEFT + 1, width)
    window = (TOP + top, TOP + bottom, LEFT + left, LEFT + right, len(ids) > 2)
    before = _loops().measure(frame, *window, _model())
    frame[frame == position[a]] = position[b]
    return before - _loops().measure(frame, *window, _model())


def smooth_labels(
    labels: Labels, costs: NDArray[np.float32] | None = None, rate: float = 0.2, *, keep: bool = True
) -> Labels:
    """Straighten contours where the bits saved are worth more than the change: a label map with loss.

    Sweeps of single pixels, in order, each to a neighbour's label if ``rate`` x bits saved exceeds the added cost.

    Args:
        labels: (H, W), non-negative ids.
        costs: (R, H, W), what it costs to give a pixel the r-th smallest id; None: 1 for any but its own.
        rate: what a bit is worth, in units of `costs`.
        keep: whether every region keeps a pixel at least.

    Returns:
        (H, W), ids of `labels`.

    Raises:
        ValueError: `costs` have another shape.

    Example:
        >>> labels = np.zeros((16, 16), np.int64)
        >>> labels[8:] = 1
        >>> labels[7, 5] = 1
        >>> int(smooth_labels(labels)[7, 5])
        0
    """
    ids, index = compact(labels)
    if costs is not None and costs.shape != (len(ids), *labels.shape):
        raise ValueError(f"costs must have shape {(len(ids), *labels.shape)}; got {costs.shape}")
    table = _NO_COSTS if costs is None else np.asarray(costs, np.float32)
    height, width = labels.shape
    sizes = np.bincount(index.reshape(-1), minlength=len(ids))
    frame = _frame(index)
    for _ in range(_SWEEPS if len(ids) > 1 else 0):
        changed = _loops().sweep(frame, index, table, sizes, float(rate), keep, len(ids) > 2, _model())
        frame = _frame(frame[TOP : TOP + height, LEFT : LEFT + width])
        if not changed:
            break
    result: Labels = ids[frame[TOP : TOP + height, LEFT : LEFT + width]]
    return result
