"""Files that no encoder wrote, with right checksums: every number as large, or as small, as the stream can say."""

from __future__ import annotations

import tracemalloc
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from kcgs.codec import CodecError, decode
from kcgs.codec.file import Header, pack
from kcgs.codec.gaussians.layers import LayerCoder
from kcgs.codec.gaussians.occupancy import Grid, Occupancy, _code_counts
from kcgs.codec.gaussians.quantize import Quantizer
from kcgs.codec.labels.ids import Remaining
from kcgs.codec.rangecoder import Writer

from .test_file import assert_sound


class Forger(Writer):
    """Reads what it makes up, and writes it."""

    reads = True

    def __init__(self, generator: np.random.Generator) -> None:
        super().__init__()
        self._generator = generator

    def _invent(self, sizes: Any) -> Any:
        kind = self._generator.integers(4)
        if kind < 2:
            return np.zeros_like(sizes) if kind else sizes - 1
        return self._generator.integers(0, sizes)

    def uniform(self, sizes: Any, values: Any) -> Any:
        return super().uniform(sizes, self._invent(sizes) if values is None else values)

    def choose(self, tables: Any, rows: Any, values: Any) -> Any:
        values = self._invent(np.full(len(rows), tables.shape[1])) if values is None else values
        return super().choose(tables, rows, values)


class ForgedOccupancy(Occupancy):
    """Makes up the cells of as many Gaussians as the layer names."""

    def code(self, coder: Any, count: int, cell: Any) -> Any:
        grid, generator = Grid.over(self._size, count), coder._generator
        margin = generator.choice([0, 1, grid.most_margin])
        corner, end = np.array([-margin, -margin]), np.array([grid.columns + margin, grid.rows + margin])
        cell = corner + (generator.random((count, 2)) ** generator.choice([1, 9]) * (end - corner)).astype(np.int64)
        return super().code(coder, count, cell[np.lexsort(cell.T)])


class ForgedLayers(LayerCoder):
    """Names any classes of size, but few Gaussians of each."""

    def _code_counts(self, coder: Any, codes: Any) -> Any:
        counts = np.zeros(64, np.int64)
        counts[coder._generator.choice([0, 1, 20, 35, 36], 2)] = coder._generator.integers(1, 80, 2)
        return super()._code_counts(coder, SimpleNamespace(size=np.repeat(np.arange(64), counts) - 8))


def forge(header: Header, generator: np.random.Generator) -> bytes:
    """Write layers of nonsense, up to one that even their writer refuses."""
    quantizer = Quantizer(header.qp, header.size)
    model, layers, energies = ForgedLayers(quantizer, header.channels, None), [], []
    model._occupancy = ForgedOccupancy(header.size)
    for energy, _ in header.layers:
        forger = Forger(generator)
        try:
            model.code(forger, energy, None, None, 5000)
        except CodecError:
            break
        layers.append(forger.finish().ljust(600, b"\0"))
        energies.append((energy, len(layers[-1])))
    return pack(header._replace(layers=tuple(energies)), b"", layers) if layers else b""


def test_any_number_that_a_file_can_hold() -> None:
    generator, sound = np.random.default_rng(0), 0
    for _ in range(300):
        energies = np.unique(generator.choice([-24, -23, 0, 5, 39, 40], 3))[::-1]
        size = [(1, 1), (7, 9), (300, 400), (1, 1 << 20), (1 << 20, 1 << 20)][generator.integers(5)]
        qp, channels = generator.choice([-512, 0, 300, 1023]), generator.choice([1, 3, 4, 20])
        data = forge(Header(size, int(channels), int(qp), 1, tuple((int(e), 1) for e in energies)), generator)
        if data:
            assert_sound(decode(data))
            sound += 1
    assert sound > 50


def write_counts(first: int, count: int) -> Writer:
    """Begin a layer of one class of size, by its position."""
    writer, one = Writer(), np.ones(1, np.int64)
    writer.uniform(64 * one, first * one)
    writer.uniform((64 - first) * one, 0 * one)
    LayerCoder(Quantizer(0, (9, 9)), 1, None)._count.code(writer, count)
    return writer


@pytest.mark.parametrize("position", [37, 63])
def test_a_class_that_there_is_not(position: int) -> None:
    layer = write_counts(position, 1).finish()
    with pytest.raises(CodecError, match="a class of size must be at most 28"):
        decode(pack(Header((9, 9), 1, 0, 1, ((0, len(layer)),)), b"", [layer]))


def test_a_ratio_that_there_is_not() -> None:
    writer, zero = write_counts(5, 1), np.zeros(1, np.int64)
    quantizer = Quantizer(-512, (9, 9))
    model = LayerCoder(quantizer, 1, None)
    model._occupancy.code(writer, 1, np.zeros((1, 2), np.int64))
    model._ratio.code(writer, 1.0, zero, zero + (1 << 23))
    layer = writer.finish()
    with pytest.raises(CodecError, match="a ratio must be at most 0 steps"):
        decode(pack(Header((9, 9), 1, -512, 1, ((-24, len(layer)),)), b"", [layer]))


def test_many_cells_take_little_memory() -> None:
    cells, nothing = 1 << 20, np.zeros(0, np.int64)
    writer = write_counts(5, 60_000)
    model = Occupancy((cells, 1))
    model._code_margin(writer, Grid.over((cells, 1), 60_000), np.zeros((1, 2), np.int64))
    _code_counts(writer, 60_000 / cells, cells, nothing, 60_000)
    layer = writer.finish().ljust(7500, b"\0")
    tracemalloc.start()
    with pytest.raises(CodecError, match="cells must hold 60000 Gaussians; got 0"):
        decode(pack(Header((1 << 20, 1), 1, 0, 1, ((0, len(layer)),)), b"", [layer]))
    assert tracemalloc.get_traced_memory()[1] < 10e6
    tracemalloc.stop()


def test_what_is_left_by_rank() -> None:
    generator = np.random.default_rng(0)
    for count in (1, 2, 7, 8, 100):
        left, expected = Remaining(count), list(range(count))
        while expected:
            rank = int(generator.integers(len(expected)))
            assert left.rank(expected[rank]) == rank
            assert left.take(rank) == expected.pop(rank)


@pytest.mark.parametrize("size", [(1, 1), (5, 7), (1, 300), (64, 48)])
@pytest.mark.parametrize("margin", [0, 1, 6])
def test_places_of_cells(size: tuple[int, int], margin: int) -> None:
    grid = Grid.over(size, 3)._replace(margin=margin)
    tall, wide = grid.rows + 2 * margin, grid.columns + 2 * margin
    row, column = np.divmod(np.arange(tall * wide), wide)
    cell = np.stack([column, row], -1) - margin
    inside, outside = grid.split(cell)
    assert inside.tolist() == list(range(grid.rows * grid.columns))
    assert outside.tolist() == list(range(grid.num_outside))
    assert np.array_equal(grid.join(inside, outside), cell)
