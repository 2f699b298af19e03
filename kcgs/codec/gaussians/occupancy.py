"""The number of Gaussians of a class in each cell of a grid over the image; their order is free (docs/format.md)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from kcgs.codec.adaptive import AdaptiveNumber
from kcgs.codec.exact import Floats, Integers
from kcgs.codec.rangecoder import ONE, CodecError, Coder

COUNT_BITS = 21  # bits of the largest number of Gaussians
_CELLS_PER_GAUSSIAN = 16  # least number of cells per Gaussian, if cells are larger than a pixel

# limits on cells outside the image: Gaussians beyond them are moved to the border
_MAX_MARGIN = 255  # cells beyond each side
_MAX_OUTSIDE = 1 << 17  # cells outside of a grid, in addition to 15 times the cells inside
# limits that keep the work of a decoder below hours
_MAX_TOTAL_OUTSIDE = 1 << 26  # cells outside of all grids of a file, in addition to those for its Gaussians
_MAX_OUTSIDE_EACH = 1 << 10  # cells outside for each Gaussian of the file
_MAX_CLASSES = 1 << 12  # classes of size in all groups; an encoder has at most 65 * 37

# first weights, by count of bits
_MARGIN_WEIGHTS = np.array([3.0, *[1.0] * 4, *[0.3] * 4])
_OUTSIDE_WEIGHTS = np.array([0.3, *[1.0] * 4, *[0.3] * (COUNT_BITS - 4)])

# the weight of a cell depends on the density of earlier Gaussians
_DENSITY_SIZES = 2  # larger classes of size that count in addition to the Gaussian's own
_REACH = 4  # columns and rows on each side to which a Gaussian adds density
_KERNEL_SUM = 625  # total density that a Gaussian adds: (1 + 2 + 3 + 4 + 5 + 4 + 3 + 2 + 1)^2
_WEIGHT_PARTS = 64  # weight of a unit of density
_PRIOR_GAUSSIANS = 12  # Gaussians whose density all cells share equally

_MIN_CHANCE = 16  # least chance of one more Gaussian in a cell, in 1 / ONE
_MIN_BANDS = 8  # least number of bands; after each band the number of remaining Gaussians is known
_GROUP = 1 << 16  # cells whose weights are in memory at a time


class Grid(NamedTuple):
    """Cells over an image, and a margin of cells around them; columns and rows count from the image's corner."""

    side: int  # pixels
    rows: int
    columns: int
    margin: int = 0

    @classmethod
    def for_count(cls, size: tuple[int, int], count: int) -> Grid:
        """Return the grid for `count` Gaussians: 16 to 64 cells per Gaussian, each at least a pixel."""
        cells = size[0] * size[1] // (_CELLS_PER_GAUSSIAN * max(count, 1))
        return cls.of_side(size, 1 << max(0, (cells.bit_length() - 1) // 2))

    @classmethod
    def of_side(cls, size: tuple[int, int], side: int) -> Grid:
        """Return the grid of cells of `side` pixels over an image of `size`."""
        return cls(side, -(-size[0] // side), -(-size[1] // side))

    @property
    def max_margin(self) -> int:
        """The largest margin m for which (rows + 2 m) (columns + 2 m) is within the limit."""
        excess, perimeter = _MAX_OUTSIDE + 15 * self.rows * self.columns, self.rows + self.columns
        return min((math.isqrt(perimeter * perimeter + 4 * excess) - perimeter) // 4, _MAX_MARGIN)

    @property
    def num_outside(self) -> int:
        """The number of cells of the margin."""
        return (self.rows + 2 * self.margin) * (self.columns + 2 * self.margin) - self.rows * self.columns

    def split(self, cell: Integers) -> tuple[Integers, Integers]:
        """Return the indices of `cell` (N, 2), in order, among the cells inside, and among those outside."""
        column, row = cell.T
        is_inside_row = (row >= 0) & (row < self.rows)
        is_inside = is_inside_row & (column >= 0) & (column < self.columns)
        # for each cell the number of cells inside before it, and the number of all cells before it
        inside = np.clip(row, 0, self.rows) * self.columns
        inside += np.where(is_inside_row, np.clip(column, 0, self.columns), 0)
        index = (row + self.margin) * (self.columns + 2 * self.margin) + column + self.margin
        return inside[is_inside], (index - inside)[~is_inside]

    def join(self, inside: Integers, outside: Integers) -> Integers:
        """Return the cells (N, 2) of indices from `split`, in order."""
        width, ring = self.columns + 2 * self.margin, max(2 * self.margin, 1)
        top = self.margin * width
        row, column = np.divmod(outside - top, ring)
        beside = top + row * width + column + np.where(column >= self.margin, self.columns, 0)
        below = outside + self.rows * self.columns
        index = np.where(outside < top, outside, np.where(row < self.rows, beside, below))
        row, column = np.divmod(inside, self.columns)
        index = np.concatenate([(row + self.margin) * width + column + self.margin, index])
        # both halves are sorted: a stable sort merges them
        row, column = np.divmod(np.sort(index, kind="stable"), width)
        return np.stack([column - self.margin, row - self.margin], -1)


class OccupancyCoder:
    """Code the cells of one class of size after another; earlier classes give the weights of later classes' cells."""

    def __init__(self, size: tuple[int, int]) -> None:
        self._size = size
        self._margin = AdaptiveNumber(_MARGIN_WEIGHTS)
        self._num_outside = AdaptiveNumber(_OUTSIDE_WEIGHTS)
        # of each class so far: its size, and the centres of its cells in half pixels
        self._classes: list[tuple[int, Integers]] = []
        self._total_outside = 0  # cells of margins so far
        self._total = 0  # Gaussians so far

    def code(self, coder: Coder, size: int, cell: Integers) -> Integers:
        """Code the cells (N, 2) of the Gaussians of a class of size, sorted row by row."""
        count = len(cell)
        if len(self._classes) == _MAX_CLASSES:
            raise CodecError(f"groups must have at most {_MAX_CLASSES} classes of size; got more")
        grid = Grid.for_count(self._size, count)
        grid = grid._replace(margin=self._code_margin(coder, grid, cell))
        inside, outside = grid.split(cell)
        num_outside = 0
        if grid.margin:
            num_outside = self._num_outside.code(coder, len(outside))
            if num_outside > count:
                raise CodecError(f"at most {count} Gaussians may lie outside; got {num_outside}")
        inside = self._code_inside(coder, grid, size, count - num_outside, inside)
        outside = self._code_outside(coder, grid, count, num_outside, outside)
        cell = grid.join(inside, outside)
        self._classes.append((size, (2 * cell + 1) * grid.side))
        return cell

    def _code_margin(self, coder: Coder, grid: Grid, cell: Integers) -> int:
        distance = max(0, -cell.min(), (cell - [grid.columns, grid.rows]).max() + 1)
        margin = self._margin.code(coder, int(distance))
        if margin > grid.max_margin:
            raise CodecError(f"a margin must be at most {grid.max_margin} cells; got {margin}")
        return margin

    def _code_inside(self, coder: Coder, grid: Grid, size: int, count: int, index: Integers) -> Integers:
        """Code the cells inside; a cell is likelier where earlier Gaussians of about this size are denser."""
        shape, num_cells = (grid.rows, grid.columns), grid.rows * grid.columns
        cells = [middle // (2 * grid.side) for other, middle in self._classes if size <= other <= size + _DENSITY_SIZES]
        column, row = np.concatenate([np.zeros((0, 2), np.int64), *cells]).T
        is_inside = (row >= 0) & (row < grid.rows) & (column >= 0) & (column < grid.columns)
        column, row = column[is_inside], row[is_inside]
        base = max(_WEIGHT_PARTS * _KERNEL_SUM * _PRIOR_GAUSSIANS // num_cells, 1)

        def weigh(start: int, end: int) -> Floats:
            density = _sum_density(column, row, shape, start // grid.columns, end // grid.columns)
            return (base + _WEIGHT_PARTS * density).ravel()

        borders = [row * grid.columns for row in _borders(grid.rows, num_cells)]
        total = base * num_cells + _WEIGHT_PARTS * _KERNEL_SUM * len(row)
        return _code_cells(coder, borders, weigh, total, count, index)

    def _code_outside(self, coder: Coder, grid: Grid, count: int, num_outside: int, index: Integers) -> Integers:
        """Code the cells outside, all equally likely."""
        num_cells = grid.num_outside
        self._total += count
        self._total_outside += num_cells if num_outside else 0
        max_outside = _MAX_TOTAL_OUTSIDE + _MAX_OUTSIDE_EACH * self._total
        if self._total_outside > max_outside:
            raise CodecError(f"grids must have at most {max_outside} cells outside; got {self._total_outside}")
        borders = _borders(num_cells, num_cells)
        return _code_cells(coder, borders, lambda start, end: np.ones(end - start), num_cells, num_outside, index)


def _borders(length: int, num_cells: int) -> list[int]:
    """Divide a length into bands, so that none has too many of the `num_cells` cells."""
    bands = max(_MIN_BANDS, -(-num_cells // _GROUP))
    return sorted({length * i // bands for i in range(bands + 1)})


def _sum_density(column: Integers, row: Integers, shape: tuple[int, int], first: int, last: int) -> Floats:
    """Sum the density of Gaussians in the cells of rows first to last - 1, mirrored at the grid's borders.

    The density of a Gaussian falls linearly with the distance in columns and in rows; two box filters do this.
    """
    top, bottom = max(first - _REACH, 0), min(last + _REACH, shape[0])
    is_within = (row >= top) & (row < bottom)
    index = (row[is_within] - top) * shape[1] + column[is_within]
    density = np.bincount(index, minlength=(bottom - top) * shape[1]).reshape(-1, shape[1]).astype(np.int32)
    above = _REACH - (first - top) if top == 0 else 0
    below = _REACH - (bottom - last) if bottom == shape[0] else 0
    density = np.pad(density, [(above, below), (_REACH, _REACH)], "symmetric")
    for _ in range(4):  # along columns and rows, twice
        density = (density[4:] + density[3:-1] + density[2:-2] + density[1:-3] + density[:-4]).T
    return density.astype(np.float64)


def _code_cells(
    coder: Coder,
    borders: list[int],
    weigh: Callable[[int, int], Floats],
    total: float,
    count: int,
    index: Integers,
) -> Integers:
    """Code the cells of `count` Gaussians, in order, band by band; the weights of all cells add up to `total`."""
    remaining, parts = count, [np.zeros(0, np.int64)]
    bands_per_group = _MIN_BANDS if borders[-1] <= _GROUP else 1
    for first in range(0, len(borders) - 1, bands_per_group):
        if not remaining:
            break
        bands = borders[first : first + bands_per_group + 1]
        weights = weigh(bands[0], bands[-1])
        for start, end in itertools.pairwise(bands):
            weight = weights[start - bands[0] : end - bands[0]]
            rate = remaining * weight
            chances = np.clip(np.floor(ONE * rate / (rate + total)), _MIN_CHANCE, ONE - _MIN_CHANCE) / ONE
            total -= float(weight.sum())
            part = index[slice(*np.searchsorted(index, [start, end]))] - start
            parts.append(start + _code_band(coder, chances, remaining, part))
            remaining -= len(parts[-1])
    if remaining:
        raise CodecError(f"cells must hold {count} Gaussians; got {count - remaining}")
    return np.concatenate(parts)


def _code_band(coder: Coder, chances: Floats, max_count: int, index: Integers) -> Integers:
    """Code the cells of at most `max_count` Gaussians: each bit says whether a cell has one more Gaussian."""
    cells = np.arange(len(chances) if max_count else 0)
    counts = np.bincount(index, minlength=len(chances))
    rounds, total = [cells[:0]], 0
    while len(cells):
        bits = (counts[cells] > len(rounds) - 1).astype(np.int32)
        cells = cells[np.asarray(coder.bits(chances[cells], bits)) > 0]
        rounds.append(cells)
        total += len(cells)
        if total > max_count:
            raise CodecError(f"cells must hold at most the {max_count} Gaussians that remain; got more")
    return np.sort(np.concatenate(rounds), kind="stable")
