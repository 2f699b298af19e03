"""Files that no encoder wrote, with right checksums: every number as large, or as small, as the stream can say."""

from __future__ import annotations

import tracemalloc
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from kcgs.codec import CodecError, decode
from kcgs.codec.exact import Integers
from kcgs.codec.file import Header, pack
from kcgs.codec.gaussians.layers import Group, LayerCoder
from kcgs.codec.gaussians.occupancy import Grid, Occupancy, _code_margin
from kcgs.codec.gaussians.quantize import Classes, Quantizer
from kcgs.codec.labels.ids import Remaining
from kcgs.codec.rangecoder import Reader, Writer
from kcgs.codec.scenes import SceneWriter

from .conftest import make_scene
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

    def number(self, value: int, size: int) -> int:
        return super().number(int(self._generator.integers(size) * self._generator.integers(2)), size)

    def choose(self, tables: Any, rows: Any, values: Any) -> Any:
        values = self._invent(np.full(len(rows), tables.shape[1])) if values is None else values
        return super().choose(tables, rows, values)


class ForgedOccupancy(Occupancy):
    """Makes up the cells of as many Gaussians as the layer names."""

    def code(self, coder: Any, size: int, count: int, cell: Any) -> Any:
        grid, generator = Grid.over(self._size, count), coder._generator
        margin = generator.choice([0, 1, grid.most_margin])
        corner, end = np.array([-margin, -margin]), np.array([grid.columns + margin, grid.rows + margin])
        cell = corner + (generator.random((count, 2)) ** generator.choice([1, 9]) * (end - corner)).astype(np.int64)
        return super().code(coder, size, count, cell[np.lexsort(cell.T)])


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
            model.code(forger, energy, None, 5000)
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


def write_counts(first: int, count: int, writer: Writer | None = None) -> Writer:
    """Begin a layer of one class of size, by its position."""
    writer, one = writer or Writer(), np.ones(1, np.int64)
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
    model._occupancy.code(writer, -3, 1, np.zeros((1, 2), np.int64))
    model._magnitudes[-1].code(writer, np.ones(1), zero, zero, zero + (1 << 23))
    layer = writer.finish()
    with pytest.raises(CodecError, match="a ratio must be at most 0 steps"):
        decode(pack(Header((9, 9), 1, -512, 1, ((-24, len(layer)),)), b"", [layer]))


def write_nothing(size: tuple[int, int], count: int) -> bytes:
    """Name Gaussians of a class of size, but cells that hold none."""
    writer, grid = write_counts(5, count), Grid.over(size, count)
    _code_margin(writer, Occupancy(size)._margin, grid, np.zeros((1, 2), np.int64))
    cells, chance = grid.rows * grid.columns, 65536 * count / (count + grid.rows * grid.columns)
    for _ in range(0, cells, 65536):
        writer.bits(np.full(65536, np.floor(chance) / 65536), np.zeros(65536, np.int32))
    layer = writer.finish().ljust(count // 8, b"\0")
    return pack(Header(size, 1, 0, 1, ((0, len(layer)),)), b"", [layer])


# a row of cells is in memory, with as many as may lie near it
@pytest.mark.parametrize(("size", "most"), [((1 << 20, 1), 10e6), ((1 << 10, 1 << 10), 10e6), ((1, 1 << 20), 70e6)])
def test_many_cells_take_little_memory(size: tuple[int, int], most: float) -> None:
    data = write_nothing(size, 60_000)
    tracemalloc.start()
    with pytest.raises(CodecError, match="cells must hold 60000 Gaussians; got 0"):
        decode(data)
    assert tracemalloc.get_traced_memory()[1] < most
    tracemalloc.stop()


class Scripted(Writer):
    """Writes these numbers after groups, in place of the true ones."""

    def __init__(self, *following: int) -> None:
        super().__init__()
        self._following = list(following)

    def number(self, value: int, size: int) -> int:
        return super().number(self._following.pop(0), size)


def make_group(quantizer: Quantizer, energy: int, count: int = 5) -> Group:
    """Round Gaussians as if they had this energy."""
    writer = SceneWriter(make_scene(count, quantizer.size, 1, channels=1))
    classes = Classes(np.full(count, energy), np.zeros(count, np.int64))
    codes = quantizer.quantize(writer.gaussians, classes)
    return codes.pick(np.lexsort(codes.cell.T)), writer.ids


@pytest.mark.parametrize(("energy", "following"), [(-24, [1]), (-24, [2]), (-23, [1, 1]), (-22, [2, 2, 2])])
def test_an_energy_below_all(energy: int, following: list[int]) -> None:
    writer, quantizer, message = Scripted(*following), Quantizer(0, (9, 9)), "must be at least -24; got -25"
    groups = [make_group(quantizer, energy - i) for i in range(1 + following[:-1].count(1))]
    with pytest.raises(CodecError, match=message):
        LayerCoder(quantizer, 1, None).code(writer, energy, groups, 5000)
    layer = writer.finish()
    with pytest.raises(CodecError, match=message):
        decode(pack(Header((9, 9), 1, 0, 1, ((energy, len(layer)),)), b"", [layer]))


def test_groups_of_more_than_their_layer_may_hold() -> None:
    writer, quantizer = Writer(), Quantizer(0, (9, 9))
    model = LayerCoder(quantizer, 1, None)
    model._code_group(writer, 0, make_group(quantizer, 0), 5)
    writer.number(1, 3)
    model._code_counts(writer, SimpleNamespace(size=np.zeros(5000, np.int64)))  # type: ignore[arg-type]
    layer = writer.finish()
    with pytest.raises(CodecError, match=f"a layer must hold at most {8 * len(layer) + 64 - 5} Gaussians; got 5000"):
        decode(pack(Header((9, 9), 1, 0, 1, ((0, len(layer)),)), b"", [layer]))


class Stubborn(Writer):
    """Writes one bit, whatever it is asked for."""

    def __init__(self, bit: int) -> None:
        super().__init__()
        self.bit = bit

    def bits(self, chances: Any, values: Any) -> Any:
        return super().bits(chances, np.full(len(chances), self.bit, np.int32))


@pytest.mark.parametrize(
    ("margin", "beyond", "bit", "match"),
    [
        (0, 0, 0, "cells must hold 2 Gaussians; got 0"),
        (0, 0, 1, "cells must hold no more Gaussians than are left; got more"),
        (1, 2, 0, "cells must hold 2 Gaussians; got 0"),
        (1, 2, 1, "cells must hold no more Gaussians than are left; got more"),
        (1, 3, 0, "at most 2 Gaussians may lie outside; got 3"),
        (255, 0, 0, "a margin must be at most 177 cells; got 255"),
    ],
)
def test_cells_that_hold_others_than_were_named(margin: int, beyond: int, bit: int, match: str) -> None:
    writer, model = write_counts(5, 2, Stubborn(bit)), Occupancy((9, 9))
    true = model._margin, model._beyond
    model._margin, model._beyond = (  # type: ignore[assignment]
        SimpleNamespace(code=lambda coder, _, number=number, value=value: number.code(coder, value))
        for number, value in zip(true, (margin, beyond), strict=True)
    )
    with pytest.raises(CodecError, match=match):
        model.code(writer, -3, 2, None)
    layer = writer.finish()
    with pytest.raises(CodecError, match=match):
        decode(pack(Header((9, 9), 1, 0, 1, ((0, len(layer)),)), b"", [layer]))


def test_grids_that_would_take_hours(monkeypatch: pytest.MonkeyPatch) -> None:
    size, writer, encoder = (9, 9), Writer(), Occupancy((9, 9))
    far = np.full((1, 2), -Grid.over(size, 1).most_margin)
    for class_of_size in range(5):
        encoder.code(writer, class_of_size, 1, far)
    reader, decoder = Reader(writer.finish()), Occupancy(size)
    monkeypatch.setattr(f"{Occupancy.__module__}._ALL_OUTSIDE", 4 << 17)
    monkeypatch.setattr(f"{Occupancy.__module__}._EACH_OUTSIDE", 0)
    for class_of_size in range(4):
        decoder.code(reader, class_of_size, 1, None)
    with pytest.raises(CodecError, match="at most 524288 cells outside; got 6"):
        decoder.code(reader, 4, 1, None)
    monkeypatch.setattr(f"{Occupancy.__module__}._ALL_CLASSES", 4)
    with pytest.raises(CodecError, match="at most 4 classes of size; got more"):
        decoder.code(reader, 4, 1, None)


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


def write_cells(size: tuple[int, int], count: int) -> tuple[bytes, list[tuple[int, Integers]]]:
    """Write the cells of three classes of size, some outside; return the classes and their cells, too."""
    generator, writer, coder, listed = np.random.default_rng(0), Writer(), Occupancy(size), []
    for class_of_size, share in ((2, 1.0), (1, 0.4), (2, 0.01)):
        some = max(int(share * count), 1)
        grid = Grid.over(size, some)
        column, row = ((generator.random(some) ** 2 * (n + 1)).astype(int) for n in (grid.columns, grid.rows))
        cell = np.stack([column, row], -1)
        listed.append((class_of_size, cell[np.lexsort(cell.T)]))
        coder.code(writer, class_of_size, some, listed[-1][1])
    return writer.finish(), listed


@pytest.mark.parametrize("size", [(1, 1), (1, 3000), (3000, 1), (3, 1000), (1024, 1024), (1, 1 << 20), (1 << 20, 1)])
def test_cells_of_any_shape(size: tuple[int, int]) -> None:
    data, listed = write_cells(size, min(40_000, size[0] * size[1]))
    reader, decoder = Reader(data), Occupancy(size)
    for class_of_size, cell in listed:
        assert np.array_equal(decoder.code(reader, class_of_size, len(cell), None), cell)
