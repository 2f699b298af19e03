"""How many Gaussians of a class lie in each cell of a grid over the image; their order is free (docs/format.md)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from kcgs.codec.adaptive import AdaptiveNumber
from kcgs.codec.exact import Integers
from kcgs.codec.rangecoder import CodecError, Coder

# cells beyond the image on each side; centres farther out are brought to the border of that
_MOST_MARGIN = 255
_CELLS_OUTSIDE = 1 << 17
# larger counts of a cell are coded by repeating this
_FULL = 7
# cells that are coded together
_TOGETHER = 1 << 16


class Grid(NamedTuple):
    """Cells over an image, with a margin of more around them; columns and rows count from the image's corner."""

    side: int
    rows: int
    columns: int
    margin: int = 0

    @classmethod
    def over(cls, size: tuple[int, int], count: int) -> Grid:
        """Return the cells of `count` Gaussians: 16 to 64 cells per Gaussian, of at least a pixel."""
        cells = size[0] * size[1] // (16 * max(count, 1))
        return cls.of_side(size, 1 << max(0, (cells.bit_length() - 1) // 2))

    @classmethod
    def of_side(cls, size: tuple[int, int], side: int) -> Grid:
        """Return the cells of `side` pixels that an image of `size` has."""
        return cls(side, -(-size[0] // side), -(-size[1] // side))

    @property
    def most_margin(self) -> int:
        """How many cells there may be beyond each side of the image."""
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
        place = (row + self.margin) * (self.columns + 2 * self.margin) + column + self.margin
        return before[within], (place - before)[~within]

    def join(self, inside: Integers, outside: Integers) -> Integers:
        """Return the cells (N, 2) of such places, in order."""
        wide, ring = self.columns + 2 * self.margin, max(2 * self.margin, 1)
        top = self.margin * wide
        row, rest = np.divmod(outside - top, ring)
        beside = top + row * wide + rest + np.where(rest >= self.margin, self.columns, 0)
        below = outside + self.rows * self.columns
        place = np.where(outside < top, outside, np.where(row < self.rows, beside, below))
        row, column = np.divmod(inside, self.columns)
        # both are in order, which a stable sort makes use of
        place = np.sort(np.concatenate([(row + self.margin) * wide + column + self.margin, place]), kind="stable")
        row, column = np.divmod(place, wide)
        return np.stack([column - self.margin, row - self.margin], -1)


class Occupancy:
    """Codes the cells of one class after another; what was learned in one helps the next."""

    def __init__(self, size: tuple[int, int]) -> None:
        self._size = size
        self._margin = AdaptiveNumber(np.array([3.0, *[1.0] * 4, *[0.3] * 4]))
        self._outside = 0.5, 20.0

    def code(self, coder: Coder, count: int, cell: Integers | None) -> Integers:
        """Code the cells (N, 2) of `count` Gaussians, sorted row by row; None: to read."""
        grid = Grid.over(self._size, count)
        grid = grid._replace(margin=self._code_margin(coder, grid, cell))
        places = (None, None) if cell is None else grid.split(cell)
        out, seen = self._outside
        share = out / seen if grid.margin else 0.0
        cells = grid.rows * grid.columns, grid.num_outside
        rates = [max(count * part, 0.01) / max(n, 1) for part, n in zip((1.0 - share, share), cells, strict=True)]
        inside = _code_counts(coder, rates[0], cells[0], places[0], count)
        outside = _code_counts(coder, rates[1], cells[1], places[1], count - len(inside))
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
        margin = self._margin.code(coder, margin)
        if margin > grid.most_margin:
            raise CodecError(f"a margin must be at most {grid.most_margin} cells; got {margin}")
        return margin


def _code_counts(coder: Coder, rate: float, cells: int, places: Integers | None, most: int) -> Integers:
    """Code which cell each Gaussian lies in, in order: one more with the probability rate / (1 + rate) each."""
    more, left = rate / (1.0 + rate), most
    weights = np.multiply.accumulate([1.0 - more, *[more] * _FULL])
    weights[_FULL] /= 1.0 - more

    def code(count: int, wanted: Integers | None) -> Integers:
        nonlocal left
        found = coder.repeat(weights, count, None if wanted is None else np.minimum(wanted, _FULL))
        left -= int(found.sum())
        if left < 0:
            raise CodecError(f"cells must hold {most} Gaussians; got more")
        return found

    occupied, counts = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for start in range(0, cells, _TOGETHER):
        together, wanted = min(_TOGETHER, cells - start), None
        if places is not None:
            first, last = np.searchsorted(places, [start, start + together])
            wanted = np.bincount(places[first:last] - start, minlength=together)
        found = code(together, wanted)
        occupied.append(np.flatnonzero(found) + start)
        counts.append(found[found > 0])
    where, count = np.concatenate(occupied), np.concatenate(counts)
    true = None if places is None else np.searchsorted(places, where, "right") - np.searchsorted(places, where)
    full = np.flatnonzero(count == _FULL)
    while len(full):
        found = code(len(full), None if true is None else (true - count)[full])
        count[full] += found
        full = full[found == _FULL]
    return np.repeat(where, count)
