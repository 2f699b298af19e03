"""The greedy choice of matching pursuit, as a compiled loop."""

from __future__ import annotations

import math

import numpy as np

from kcgs.kernels.compiled import Program, inner

# candidates of which the largest gain is kept
_BLOCK = 128

program = Program("matching pursuit", __file__)


@inner
def _refresh(gain, leaders, first, last):  # type: ignore[no-untyped-def]
    """Find the largest gain, of equal ones the first, of the blocks that hold candidates from first to last."""
    for block in range(first // _BLOCK, (last + _BLOCK - 1) // _BLOCK):
        best = block * _BLOCK
        for i in range(best + 1, min(best + _BLOCK, len(gain))):
            if gain[i] > gain[best]:
                best = i
        leaders[block] = best


@program.entry
def choose(places, square, norm, share, gain, limits, picked):  # type: ignore[no-untyped-def]
    """Pick the largest gain, subtract its share of the error from its neighbours', and again; return the count.

    Places are (x, y, order), sorted by the last: the neighbours of a place lie within one stretch of it. Limits are the
    least gain, the largest overlap, the reach in standard deviations, and the longest reach.
    """
    floor, max_overlap, reach, longest = limits
    widest = square.max()
    leaders = np.empty((len(gain) + _BLOCK - 1) // _BLOCK, np.int64)
    _refresh(gain, leaders, 0, len(gain))
    order = places[:, 2]
    for count in range(len(picked)):
        best = leaders[0]
        for leader in leaders[1:]:
            if gain[leader] > gain[best]:
                best = leader
        if gain[best] <= floor:
            return count
        picked[count] = best
        x, y, middle = places[best, 0], places[best, 1], order[best]
        best_square, best_norm, best_share = square[best], norm[best], share[best].copy()
        far = min(reach * math.sqrt(best_square + widest), longest)
        low = np.searchsorted(order, middle - far)
        high = np.searchsorted(order, middle + far)
        for i in range(low, high):
            dx = places[i, 0] - x
            if abs(dx) > far or gain[i] < 0.0:
                continue
            variance, dy = square[i] + best_square, places[i, 1] - y
            # in a small region Gaussians of all widths are the same: there their norms are what compares
            similarity = max(
                math.sqrt(square[i] * best_square) / variance, math.sqrt(norm[i] * best_norm) / (norm[i] + best_norm)
            )
            overlap = 2.0 * similarity * math.exp(-0.5 * (dx * dx + dy * dy) / variance)
            total = 0.0
            for c in range(len(best_share)):
                share[i, c] -= overlap * best_share[c]
                total += share[i, c] * share[i, c]
            gain[i] = -1.0 if overlap > max_overlap else total
        _refresh(gain, leaders, low, high)
    return len(picked)
