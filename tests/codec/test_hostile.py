"""Damaged files, and files with right checksums that no encoder wrote: a CodecError, or a valid scene or map."""

from __future__ import annotations

import random
import re
import tracemalloc
import zlib

import numpy as np
import pytest
import torch

from kcgs import RegionMap, Scene
from kcgs.codec import CodecError, Decoded, decode, decode_labels, encode, encode_labels
from kcgs.codec.file import Header, pack, unpack
from kcgs.codec.gaussians.layers import LayerCoder
from kcgs.codec.gaussians.occupancy import Grid, OccupancyCoder
from kcgs.codec.gaussians.quantize import Quantizer
from kcgs.codec.labels import stream
from kcgs.codec.labels.ids import _code_count
from kcgs.codec.rangecoder import Reader, Writer

from .conftest import GOLDEN, make_labels
from .damage import damaged, damaged_inside
from .test_label_files import DTYPES


def is_scene(data: bytes) -> bool:
    """Decode; a scene must be a valid one."""
    try:
        decoded = decode(data)
    except CodecError as error:
        assert str(error)
        return False
    assert_valid(decoded)
    return True


def assert_valid(decoded: Decoded) -> None:
    field, regions = decoded.scene.field, decoded.scene.regions
    for numbers in (field.means, field.cholesky, field.colors):
        assert torch.isfinite(numbers).all()
    assert (field.cholesky[:, ::2] > 0).all()
    if regions is not None:
        assert field.region_ids is not None and (regions.index_of(field.region_ids) >= 0).all()
        assert regions.size == field.size


class TestDamagedScenes:
    @pytest.mark.parametrize(("count", "seed"), [(40, 0), pytest.param(10_000, 1, marks=pytest.mark.slow)])
    def test_any_damage(self, count: int, seed: int) -> None:
        data, generator, num_cut, num_forged = GOLDEN.read_bytes(), random.Random(seed), 0, 0
        for _ in range(count // 2):
            mutated = damaged(data, generator)
            num_cut += is_scene(mutated) and mutated != data
            num_forged += is_scene(damaged_inside(data, generator))
        assert num_cut > 0 and num_forged > 0

    @pytest.mark.parametrize("step", [29, pytest.param(1, marks=pytest.mark.slow)])
    def test_cuts_are_coarser_scenes(self, step: int) -> None:
        data = GOLDEN.read_bytes()
        layers = [length + 2 for _, length in unpack(data)[0].layers]
        ends = [len(data) - sum(layers[index:]) for index in range(1, len(layers))]
        counts = []
        for length in sorted({*range(0, len(data), step), *ends, *(end - 1 for end in ends)}):
            if length < ends[0]:
                assert not is_scene(data[:length])
            else:
                decoded = decode(data[:length])
                assert decoded.layers == sum(end <= length for end in ends) < decoded.num_layers
                counts.append(decoded.scene.num_gaussians)
        assert counts == sorted(counts) and len({*counts}) == len(ends)

    def test_surplus_bytes(self, data: bytes, scene: Scene) -> None:
        with pytest.raises(CodecError, match="the file must end after"):
            decode(data + b"\0")
        uniform = RegionMap(scene.regions.labels, 0.5)
        header, region_map, layers = unpack(encode(Scene(scene.field, uniform)))
        with pytest.raises(CodecError, match="the map must end after"):
            decode(pack(header, region_map + b"\0", layers))

    def test_headers(self, data: bytes) -> None:
        header, region_map, layers = unpack(data)
        with pytest.raises(CodecError, match=r"layers must be in \[1, 128\]; got 129"):
            decode(pack(header._replace(layers=(header.layers[0],) * 129), region_map, [layers[0]] * 129))
        with pytest.raises(CodecError, match="an image with regions must have at most 67108864 pixels"):
            decode(pack(header._replace(size=(1 << 20, 1 << 20)), region_map, layers))
        with pytest.raises(CodecError, match="its version must be 1; got 2"):
            decode(b"kcgs\2" + data[5:])

    @pytest.mark.parametrize(
        ("regions", "match"),
        [(4, "the map must have 4 regions; got 3"), (24 * 36 + 1, r"regions must be in \[1, 864\]; got 865")],
    )
    def test_number_of_regions(self, regions: int, match: str, data: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
        """It is checked before pixels are decoded."""
        monkeypatch.setattr(stream, "code_pixels", None)
        header, region_map, layers = unpack(data)
        with pytest.raises(CodecError, match=match):
            decode(pack(header._replace(regions=regions), region_map, layers))


@pytest.fixture(scope="module")
def files() -> list[bytes]:
    return [encode_labels(make_labels(seed, (48, 64), 5) * 7) for seed in range(3)]


def forge_map(form: int, size: bytes, stream: bytes) -> bytes:
    content = b"kcgm" + bytes([form]) + size + stream
    return content + zlib.crc32(content).to_bytes(4, "big")


class TestDamagedMaps:
    def test_any_damage(self, files: list[bytes]) -> None:
        generator = random.Random(0)
        for trial in range(300):
            mutated = damaged(files[trial % 3], generator)
            if mutated != files[trial % 3]:
                with pytest.raises(CodecError):
                    decode_labels(mutated)

    def test_right_checksums(self, files: list[bytes]) -> None:
        """What decodes is a map of the size and type that the file names."""
        generator, num_valid = random.Random(1), 0
        for trial in range(200):
            form = generator.randrange(64)
            try:
                labels = decode_labels(forge_map(form, b"\x30\x40", damaged(files[trial % 3][7:-4], generator)))
            except CodecError as error:
                assert str(error)
                continue
            num_valid += 1
            assert labels.shape == (48, 64) and labels.dtype == DTYPES[form >> 3] and labels.long().min() >= 0
        assert num_valid > 15

    @pytest.mark.parametrize(
        ("data", "match"),
        [
            (b"", "data must be a label map.*got b''"),
            (b"kcgs\1 and so on", "data must be a label map.*a scene, which kcgs.codec.decode reads"),
            (forge_map(64, b"\1\1", b""), "turn and type must be below 64; got 64"),
            (forge_map(0, b"\0\1", b""), r"height must be in \[1, 1048576\]; got 0"),
            (forge_map(0, b"\x81\x80\x80\x80\x80\0", b""), "got a number of more than 35 bits"),
            (forge_map(0, b"\x80\x80\x40\x80\x80\x40", b""), "at most 67108864 pixels; got 1048576 x 1048576"),
            (forge_map(0, b"\1", b""), "the file ends early"),
            (forge_map(0, b"\1\1", b"\xff" * 4), "at most 1 regions; got 16777216 or more"),
        ],
    )
    def test_headers(self, data: bytes, match: str) -> None:
        with pytest.raises(CodecError, match=match):
            decode_labels(data)

    def test_wrong_type(self) -> None:
        with pytest.raises(TypeError, match="data must be bytes; got str"):
            decode_labels("kcgm")  # type: ignore[arg-type]

    def test_ids_beyond_the_type(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """They are checked before pixels are decoded."""
        data = encode_labels(make_labels(0) * 200)
        monkeypatch.setattr(stream, "code_pixels", None)
        with pytest.raises(CodecError, match=r"ids of uint8 must be at most 255; got 1000"):
            decode_labels(forge_map(data[4] % 8 + 8, data[5:8], data[8:-4]))

    def test_many_regions_of_few_bytes(self) -> None:
        """They cost neither time nor memory."""
        writer = Writer()
        _code_count(writer, 1 << 20, 1 << 20)
        with pytest.raises(CodecError, match="at most 262145 regions; got 1048576"):
            decode_labels(forge_map(0, b"\x80\x10\x80\x10", writer.finish()))


# errors of the stream of a layer
REFUSALS = (
    "a class of size must be at most 28",
    "a layer must hold Gaussians; got none",
    "a layer must hold at most",
    "a class of energy must be at least -24; got -25",
    "a margin must be at most",
    "Gaussians may lie outside",
    "cells must hold at most the",
    r"cells must hold \d+ Gaussians; got",
)


def test_any_number_that_a_file_can_hold() -> None:
    """Random numbers after the counts of a few Gaussians, or at once: each of these errors, or a valid scene."""
    generator, num_valid, messages = np.random.default_rng(0), 0, set()
    for _ in range(600):
        size = [(1, 1), (7, 9), (300, 400), (1, 1 << 20), (1 << 20, 1 << 20)][generator.integers(5)]
        options = [1, 3, 4, 20], [-512, 0, 1023], [-24, 0, 40], [0, 1, 1, 2, 3, 20]
        channels, qp, energy, count = (int(generator.choice(numbers)) for numbers in options)
        writer, model = Writer(), LayerCoder(Quantizer(qp, size), channels, None)
        if count:
            model._code_counts(writer, generator.choice([-8, 0, 12, 28], count))
        writer.uniform(np.full(100, 1 << 16), generator.integers(1 << 16, size=100))
        layer = writer.finish()
        try:
            assert_valid(decode(pack(Header(size, channels, qp, 1, ((energy, len(layer)),)), b"", [layer])))
            num_valid += 1
        except CodecError as error:
            messages.add(str(error))
    assert num_valid > 10
    assert not [refusal for refusal in REFUSALS if not any(re.search(refusal, message) for message in messages)]


def test_a_ratio_beyond_all() -> None:
    writer, zero, model = Writer(), np.zeros(1, np.int64), LayerCoder(Quantizer(-512, (9, 9)), 1, None)
    model._code_counts(writer, zero - 3)
    model._occupancy.code(writer, -3, np.zeros((1, 2), np.int64))
    model._ratio.code(writer, np.ones(1), zero, zero, zero + (1 << 23))
    layer = writer.finish()
    with pytest.raises(CodecError, match="a ratio must be at most 0 steps"):
        decode(pack(Header((9, 9), 1, -512, 1, ((-24, len(layer)),)), b"", [layer]))


def test_many_cells_take_little_memory() -> None:
    """A row of cells is in memory, with as many as may lie near it. The file names Gaussians, but cells hold none."""
    size, count = (1 << 10, 1 << 10), 60_000
    writer, grid = Writer(), Grid.for_count(size, count)
    LayerCoder(Quantizer(0, size), 1, None)._code_counts(writer, np.full(count, -3))
    OccupancyCoder(size)._code_margin(writer, grid, np.zeros((1, 2), np.int64))
    cells = grid.rows * grid.columns
    for _ in range(0, cells, 65536):
        writer.bits(np.full(65536, (65536 * count // (count + cells)) / 65536), np.zeros(65536, np.int32))
    layer = writer.finish().ljust(count // 8, b"\0")
    data = pack(Header(size, 1, 0, 1, ((0, len(layer)),)), b"", [layer])
    tracemalloc.start()
    with pytest.raises(CodecError, match="cells must hold 60000 Gaussians; got 0"):
        decode(data)
    assert tracemalloc.get_traced_memory()[1] < 10e6
    tracemalloc.stop()


def test_too_many_cells_outside(monkeypatch: pytest.MonkeyPatch) -> None:
    size, writer, encoder = (9, 9), Writer(), OccupancyCoder((9, 9))
    far = np.full((1, 2), -Grid.for_count(size, 1).max_margin)
    for class_of_size in range(5):
        encoder.code(writer, class_of_size, far)
    reader, decoder = Reader(writer.finish()), OccupancyCoder(size)
    monkeypatch.setattr(f"{OccupancyCoder.__module__}._MAX_TOTAL_OUTSIDE", 4 << 17)
    monkeypatch.setattr(f"{OccupancyCoder.__module__}._MAX_OUTSIDE_EACH", 0)
    for class_of_size in range(4):
        decoder.code(reader, class_of_size, far)
    with pytest.raises(CodecError, match="at most 524288 cells outside; got 6"):
        decoder.code(reader, 4, far)
    monkeypatch.setattr(f"{OccupancyCoder.__module__}._MAX_CLASSES", 4)
    with pytest.raises(CodecError, match="at most 4 classes of size; got more"):
        decoder.code(reader, 4, far)
