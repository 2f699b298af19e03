"""How many Gaussians of a class lie in each cell of a grid over the picture: all that is told of their order.

The grid
--------

For n Gaussians in a picture of H x W pixels the *side* of a cell is 2**floor(log2(q) / 2) pixels with
q = H W // (16 n), and 1 for q = 0; cell (column, row) begins at pixel (side x column, side x row). ceil(H / side) rows
and ceil(W / side) columns are *inside*; m more on each side are *outside*. m is at most 255, and at most such that all
cells together are no more than 2**17 plus 16 times those inside.

The stream
----------

Categorical symbols are those of `models`; weights are float64, and sums and products go from left to right.

1. The margin: the count of bits of m, by the Choices ``margins``; then m less its highest bit, a number of that bit.
2. The inside cells, row by row, as a *fill* at the rate max(n (1 - f), 0.01) / cells, then, if m > 0, the outside ones,
   row by row, at the rate max(n f, 0.01) / cells. f is 0 if m = 0, else o / a, two numbers that live as long as
   the file: they start at 0.5 and 20, and a class with m > 0 adds those outside to o and n to a.

A *fill* at rate r: with p = r / (1 + r), the weights of 0 to 7 are w_0 = 1 - p, w_i = w_(i-1) p, the last one divided
by 1 - p. Each cell has a symbol by them. Those with 7 have another one, in their order, which adds to it, and so on
until no cell has a 7.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .errors import CodecError
from .models import Choices
from .rangecoder import Coder

Integers = NDArray[np.int64]

# cells beyond the picture on each side; centres farther out are brought to the border of that
_MOST_MARGIN = 255
_CELLS_OUTSIDE = 1 << 17
# more in a cell are told by repeating this
_FULL = 7
# cells that are looked at together
_AT_ONCE = 1 << 16


class Grid(NamedTuple):
    """Cells over a picture, with a margin of more around them; columns and rows count from the picture's corner."""

    side: int
    rows: int
    columns: int
    margin: int = 0

    @classmethod
    def over(cls, size: tuple[int, int], count: int) -> Grid:
        """Return the cells of `count` Gaussians: 16 to 64 cells a Gaussian, a pixel a side at least."""
        cells = size[0] * size[1] // (16 * max(count, 1))
        return cls.of_side(size, 1 << max(0, (cells.bit_length() - 1) // 2))

    @classmethod
    def of_side(cls, size: tuple[int, int], side: int) -> Grid:
        """Return the cells of `side` pixels that a picture of `size` has."""
        return cls(side, -(-size[0] // side), -(-size[1] // side))

    @property
    def most_margin(self) -> int:
        """How many cells there may be beyond each side of the picture."""
        # the largest m with (rows + 2 m) (columns + 2 m) at most so many more than those inside
        more, both = _CELLS_OUTSIDE + 15 * self.rows * self.columns, self.rows + self.columns
        return min((math.isqrt(both * both + 4 * more) - both) // 4, _MOST_MARGIN)

    @property
    def num_outside(self) -> int:
        """How many cells the margin has."""
        return (self.rows + 2 * self.margin) * (self.columns + 2 * self.margin) - self.rows * self.columns

    def split(self, cell: Integers) -> tuple[Integers, Integers]:
        """Return the places of `cell` (N, 2), in order, among the cells inside, and among those outside."""
        column, row = cell.T
        within = (row >= 0) & (row < self.rows) & (column >= 0) & (column < self.columns)
        before = np.clip(row, 0, self.rows) * self.columns
        before += np.where((row >= 0) & (row < self.rows), np.clip(column, 0, self.columns), 0)
        at = (row + self.margin) * (self.columns + 2 * self.margin) + column + self.margin
        return before[within], (at - before)[~within]

    def join(self, inside: Integers, outside: Integers) -> Integers:
        """Return the cells (N, 2) of such places, in order."""
        wide, ring = self.columns + 2 * self.margin, max(2 * self.margin, 1)
        top = self.margin * wide
        row, rest = np.divmod(outside - top, ring)
        beside = top + row * wide + rest + np.where(rest >= self.margin, self.columns, 0)
        below = outside + self.rows * self.columns
        at = np.where(outside < top, outside, np.where(row < self.rows, beside, below))
        row, column = np.divmod(inside, self.columns)
        # both are in order, which a stable sort makes use of
        at = np.sort(np.concatenate([(row + self.margin) * wide + column + self.margin, at]), kind="stable")
        row, column = np.divmod(at, wide)
        return np.stack([column - self.margin, row - self.margin], -1)


class Cells:
    """Codes the cells of one class after another; what was learned in one helps the next.

    Args:
        size: (height, width) of the picture.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self._size = size
        self._margins = Choices(np.array([3.0, *[1.0] * 4, *[0.3] * 4]))
        self._outside = 0.5, 20.0

    def code(self, coder: Coder, count: int, cell: Integers | None) -> Integers:
        """Code the cells (N, 2) of `count` Gaussians, sorted row by row; None: to read.

        Raises:
            CodecError: a stream whose cells do not hold so many.
        """
        grid = Grid.over(self._size, count)
        grid = grid._replace(margin=self._code_margin(coder, grid, cell))
        held = (None, None) if cell is None else grid.split(cell)
        out, seen = self._outside
        share = out / seen if grid.margin else 0.0
        cells = grid.rows * grid.columns, grid.num_outside
        rates = [max(count * part, 0.01) / max(n, 1) for part, n in zip((1.0 - share, share), cells, strict=True)]
        inside = _code_fill(coder, rates[0], cells[0], held[0], count)
        outside = _code_fill(coder, rates[1], cells[1], held[1], count - len(inside))
        if len(inside) + len(outside) != count:
            raise CodecError(f"cells must hold {count} Gaussians; got {len(inside) + len(outside)}")
        if grid.margin:
            self._outside = out + float(len(outside)), seen + count
        return grid.join(inside, outside)

    def _code_margin(self, coder: Coder, grid: Grid, cell: Integers | None) -> int:
        margin = None
        if cell is not None:
            beyond = [-cell.min(), (cell[:, 0] - grid.columns + 1).max(), (cell[:, 1] - grid.rows + 1).max(), 0]
            margin = int(max(beyond))
        one = np.zeros(1, np.int64)
        length = self._margins.code(coder, one, None if margin is None else np.array([margin.bit_length()]))
        low = int(1 << (int(length[0]) - 1)) if length[0] else 0
        rest = None if margin is None else np.array([margin - low])
        found = low + int(coder.uniform(np.array([max(low, 1)]), rest)[0])
        if found > grid.most_margin:
            raise CodecError(f"a margin must be at most {grid.most_margin} cells; got {found}")
        return found


def _code_fill(coder: Coder, rate: float, cells: int, held: Integers | None, most: int) -> Integers:
    """Code which cell each Gaussian lies in, in order: one more with the probability rate / (1 + rate) each."""
    more = rate / (1.0 + rate)
    weights = np.array([1.0 - more, *[0.0] * _FULL])
    for i in range(1, _FULL + 1):
        weights[i] = weights[i - 1] * more
    weights[_FULL] /= 1.0 - more
    at, totals, left = [], [], most
    for start in range(0, cells, _AT_ONCE):
        together = min(_AT_ONCE, cells - start)
        value = None
        if held is not None:
            first, last = np.searchsorted(held, [start, start + together])
            value = np.minimum(np.bincount(held[first:last] - start, minlength=together), _FULL)
        found = coder.repeat(weights, together, value)
        at.append(np.flatnonzero(found) + start)
        totals.append(found[found > 0])
        left = _take(left, found, most)
    where, total = (np.concatenate([np.zeros(0, np.int64), *parts]).astype(np.int64) for parts in (at, totals))
    full = np.flatnonzero(total == _FULL)
    true = None if held is None else np.searchsorted(held, where, "right") - np.searchsorted(held, where)
    while len(full):
        found = coder.repeat(weights, len(full), None if true is None else np.minimum((true - total)[full], _FULL))
        total[full] += found
        left = _take(left, found, most)
        full = full[found == _FULL]
    return np.repeat(where, total)


def _take(left: int, found: Integers, most: int) -> int:
    if (taken := int(found.sum())) > left:
        raise CodecError(f"cells must hold {most} Gaussians; got more")
    return left - taken
