"""How many Gaussians of a class lie in each cell of a grid over the image; their order is free (docs/format.md)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from kcgs.codec.adaptive import AdaptiveNumber
from kcgs.codec.exact import Floats, Integers
from kcgs.codec.rangecoder import ONE, CodecError, Coder

# cells beyond the image on each side; centres farther out are brought to the border of that
MOST_BITS = 21  # of a number of Gaussians
_MOST_MARGIN = 255
_CELLS_OUTSIDE = 1 << 17
# of a file, which else would take hours to read: cells outside, and those for each Gaussian, and classes of size; an
# encoder has 65 * 37 at most
_ALL_OUTSIDE, _EACH_OUTSIDE, _ALL_CLASSES = 1 << 26, 1 << 10, 1 << 12
_MARGINS = np.array([3.0, *[1.0] * 4, *[0.3] * 4])  # weights at first
# cells that are coded together
_TOGETHER = 1 << 16
# classes of size above their own whose Gaussians others are near to; within so many cells, with weights of this sum
_NEAR, _REACH, _MASS = 2, 4, 625
# so many Gaussians count as if they were everywhere; parts of a weight
_EVERYWHERE, _PARTS = 12, 64
_LEAST = 16  # chance of one more in a cell, in 1 / ONE
# how often cells learn how many Gaussians are left
_BANDS = 8


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
        self._margin = AdaptiveNumber(_MARGINS)
        self._beyond = AdaptiveNumber(np.array([0.3, *[1.0] * 4, *[0.3] * (MOST_BITS - 4)]))
        self._classes: list[tuple[int, Integers]] = []
        self._outside, self._count = 0, 0  # cells there and Gaussians, so far

    def code(self, coder: Coder, size: int, count: int, cell: Integers | None) -> Integers:
        """Code the cells (N, 2) of `count` Gaussians of a class of size, sorted row by row; None: to read."""
        if len(self._classes) == _ALL_CLASSES:
            raise CodecError(f"groups must have at most {_ALL_CLASSES} classes of size; got more")
        grid = Grid.over(self._size, count)
        grid = grid._replace(margin=_code_margin(coder, self._margin, grid, cell))
        places = (None, None) if cell is None else grid.split(cell)
        beyond = 0
        if grid.margin and (beyond := self._beyond.code(coder, None if places[1] is None else len(places[1]))) > count:
            raise CodecError(f"at most {count} Gaussians may lie outside; got {beyond}")
        inside = self._fill_inside(coder, grid, size, count - beyond, places[0])
        ring = grid.num_outside
        self._count += count
        self._outside += ring if beyond else 0
        if self._outside > (most := _ALL_OUTSIDE + _EACH_OUTSIDE * self._count):
            raise CodecError(f"grids must have at most {most} cells outside; got {self._outside}")
        outside = _fill(coder, _borders(ring, ring), lambda start, end: np.ones(end - start), ring, beyond, places[1])
        cell = grid.join(inside, outside)
        self._classes.append((size, (2 * cell + 1) * grid.side))
        return cell

    def _fill_inside(self, coder: Coder, grid: Grid, size: int, count: int, places: Integers | None) -> Integers:
        """Code the cells inside: the more likely, the more earlier Gaussians of about this size are near."""
        shape, cells = (grid.rows, grid.columns), grid.rows * grid.columns
        near = [twice // (2 * grid.side) for other, twice in self._classes if size <= other <= size + _NEAR]
        column, row = np.concatenate([np.zeros((0, 2), np.int64), *near]).T
        within = (row >= 0) & (row < grid.rows) & (column >= 0) & (column < grid.columns)
        column, row = column[within], row[within]
        least = max(_PARTS * _MASS * _EVERYWHERE // cells, 1)

        def weigh(start: int, end: int) -> Floats:
            return (least + _PARTS * _crowd(column, row, shape, start // grid.columns, end // grid.columns)).ravel()

        borders = [row * grid.columns for row in _borders(grid.rows, cells)]
        return _fill(coder, borders, weigh, least * cells + _PARTS * _MASS * len(row), count, places)


def _borders(length: int, cells: int) -> list[int]:
    """Divide a length into bands, so that none has many of so many cells."""
    bands = max(_BANDS, -(-cells // _TOGETHER))
    return sorted({length * i // bands for i in range(bands + 1)})


def _crowd(column: Integers, row: Integers, shape: tuple[int, int], first: int, last: int) -> Floats:
    """Count Gaussians near the cells of some rows: in windows, twice; what is beyond a border is mirrored at it."""
    top, bottom = max(first - _REACH, 0), min(last + _REACH, shape[0])
    these = (row >= top) & (row < bottom)
    place = (row[these] - top) * shape[1] + column[these]
    near = np.bincount(place, minlength=(bottom - top) * shape[1]).reshape(-1, shape[1]).astype(np.int32)
    above, below = _REACH - (first - top), _REACH - (bottom - last)
    near = np.pad(near, [(above if top == 0 else 0, below if bottom == shape[0] else 0), (_REACH, _REACH)], "symmetric")
    for _ in range(2):
        near = near[4:] + near[3:-1] + near[2:-2] + near[1:-3] + near[:-4]
        near = near[:, 4:] + near[:, 3:-1] + near[:, 2:-2] + near[:, 1:-3] + near[:, :-4]
    return near.astype(np.float64)


def _fill(
    coder: Coder,
    borders: list[int],
    weigh: Callable[[int, int], Floats],
    total: float,
    count: int,
    places: Integers | None,
) -> Integers:
    """Code which cell each of `count` Gaussians lies in, in order, band by band; all cells together weigh `total`."""
    left, found = count, [np.zeros(0, np.int64)]
    together = _BANDS if borders[-1] <= _TOGETHER else 1  # whose weights are in memory
    for first in range(0, len(borders) - 1, together):
        if not left:
            break
        bands = borders[first : first + together + 1]
        weights = weigh(bands[0], bands[-1])
        for start, end in itertools.pairwise(bands):
            weight = weights[start - bands[0] : end - bands[0]]
            rate = left * weight
            chances = np.clip(np.floor(ONE * rate / (rate + total)), _LEAST, ONE - _LEAST) / ONE
            total -= float(weight.sum())
            wanted = None if places is None else places[slice(*np.searchsorted(places, [start, end]))] - start
            found.append(start + _code_band(coder, chances, left, wanted))
            left -= len(found[-1])
    if left:
        raise CodecError(f"cells must hold {count} Gaussians; got {count - left}")
    return np.concatenate(found)


def _code_band(coder: Coder, chances: Floats, most: int, places: Integers | None) -> Integers:
    """Code which cells hold at most so many Gaussians, each one more with its chance."""
    cells = np.arange(len(chances) if most else 0)
    wanted = None if places is None else np.bincount(places, minlength=len(chances))
    found, held = [cells[:0]], 0
    while len(cells):
        more = None if wanted is None else (wanted[cells] > len(found) - 1).astype(np.int32)
        cells = cells[np.asarray(coder.bits(chances[cells], more)) > 0]
        found.append(cells)
        held += len(cells)
        if held > most:
            raise CodecError("cells must hold no more Gaussians than are left; got more")
    return np.sort(np.concatenate(found), kind="stable")


def _code_margin(coder: Coder, model: AdaptiveNumber, grid: Grid, cell: Integers | None) -> int:
    margin = None
    if cell is not None:
        beyond = [-cell.min(), (cell[:, 0] - grid.columns + 1).max(), (cell[:, 1] - grid.rows + 1).max(), 0]
        margin = int(max(beyond))
    margin = model.code(coder, margin)
    if margin > grid.most_margin:
        raise CodecError(f"a margin must be at most {grid.most_margin} cells; got {margin}")
    return margin
