"""Label maps that follow: the prediction is exact, nothing is lost, nothing is trusted, what was learned stays."""

from __future__ import annotations

import hashlib
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kcgs.codec import CodecError
from kcgs.codec.labels import FollowingLabels, following, move_labels, settle_labels, still_motions
from kcgs.codec.labels.moving import MOST_FACTOR, MOST_SHIFT, UNIT
from kcgs.codec.rangecoder import Reader, Writer

from .test_labels import shapes

Maps = list[tuple[Any, Any]]


def random_map(rng: np.random.Generator, size: tuple[int, int], regions: int) -> Any:
    scale = int(rng.integers(1, 12))
    coarse = rng.integers(0, regions, (-(-size[0] // scale), -(-size[1] // scale)))
    return np.kron(coarse, np.ones((scale, scale), int))[: size[0], : size[1]].astype(np.int32)


def write(regions: int, maps: Maps) -> bytes:
    writer, labels = Writer(), FollowingLabels(regions)
    for predicted, index in maps:
        assert np.array_equal(labels.code(writer, predicted, index), index)
    return writer.finish()


def roundtrip(regions: int, maps: Maps) -> int:
    data = write(regions, maps)
    reader, labels = Reader(data), FollowingLabels(regions)
    for predicted, index in maps:
        assert np.array_equal(labels.code(reader, predicted), index)
    return len(data)


def moved_plainly(index: Any, motions: Any) -> Any:
    """Follow docs/format.md, one pixel after the other, in Python's integers."""
    height, width = index.shape
    areas = [int((index == region).sum()) for region in range(len(motions))]
    order = sorted((region for region in range(len(motions)) if areas[region]), key=lambda r: (-areas[r], r))
    moved = np.full(index.shape, -1, np.int32)
    for region in order:
        a, b, c, d, e, f = map(int, motions[region])
        for i in range(height):
            for j in range(width):
                column = (a * (2 * j + 1) + b * (2 * i + 1) + 2 * c) >> 17
                row = (d * (2 * j + 1) + e * (2 * i + 1) + 2 * f) >> 17
                if index[min(max(row, 0), height - 1), min(max(column, 0), width - 1)] == region:
                    moved[i, j] = region
    for i in range(height):
        known = np.flatnonzero(moved[i] >= 0)
        for j in np.flatnonzero(moved[i] < 0) if len(known) else ():
            sides = [int(moved[i, side[0]]) for side in (known[known < j][-1:], known[known > j][:1]) if len(side)]
            moved[i, j] = min(sides, key=order.index)
    known_rows = [i for i in range(height) if moved[i, 0] >= 0]
    for i in range(height):
        if not known_rows:
            moved[i] = order[0]
        elif moved[i, 0] < 0:
            moved[i] = moved[max((k for k in known_rows if k < i), default=known_rows[0])]
    return moved


class TestMove:
    @settings(max_examples=80)
    @given(st.data())
    def test_as_written_down(self, data: st.DataObject) -> None:
        rng = np.random.default_rng(data.draw(st.integers(0, 1 << 20)))
        regions, size = data.draw(st.integers(1, 6)), (data.draw(st.integers(1, 20)), data.draw(st.integers(1, 20)))
        index, motions = random_map(rng, size, regions), still_motions(regions)
        kind = data.draw(st.integers(0, 3))
        if kind == 1:
            motions[:, [2, 5]] = rng.integers(-30, 30, (regions, 2)) * UNIT // 4
        elif kind == 2:
            motions += rng.integers(-UNIT, UNIT, motions.shape)
        elif kind == 3:
            motions = rng.integers(-MOST_FACTOR, MOST_FACTOR + 1, motions.shape)
            motions[:, [2, 5]] *= rng.integers(1, MOST_SHIFT // MOST_FACTOR)
        assert np.array_equal(move_labels(index, motions), moved_plainly(index, motions))

    def test_nothing_moves(self) -> None:
        index = shapes(0).astype(np.int32)
        assert np.array_equal(move_labels(index, still_motions(6)), index)

    def test_the_largest_numbers(self) -> None:
        index = np.zeros((1, 1 << 20), np.int32)
        index[0, -1] = 1
        extreme = np.array([[-MOST_FACTOR, -MOST_FACTOR, -MOST_SHIFT] * 2, [-MOST_FACTOR, 0, MOST_SHIFT, 0, UNIT, 0]])
        moved = move_labels(index, extreme)
        place = np.arange(1 << 20, dtype=object)
        source = np.array((-MOST_FACTOR * (2 * place + 1) + 2 * MOST_SHIFT) >> 17, np.int64)
        assert np.array_equal(moved[0] == 1, source >= (1 << 20) - 1)

    def test_what_is_uncovered_lies_behind(self) -> None:
        index = np.zeros((20, 40), np.int32)
        index[5:15, 10:20] = 1
        motions = still_motions(2)
        motions[1, 2] = -7 * UNIT
        assert np.array_equal(move_labels(index, motions), np.roll(index, 7, 1))

    def test_refused(self) -> None:
        index = np.zeros((2, 2), np.int32)
        with pytest.raises(ValueError, match="index must be"):
            move_labels(index.astype(np.int64), still_motions(1))
        with pytest.raises(ValueError, match="index must hold"):
            move_labels(index + 1, still_motions(1))
        with pytest.raises(ValueError, match="motions must be"):
            move_labels(index, still_motions(1) / 2)
        for column, name in ((0, "factors"), (5, "shifts")):
            motions = still_motions(1)
            motions[0, column] = -(1 << 37) - 1
            with pytest.raises(ValueError, match=name):
                move_labels(index, motions)


class TestCoder:
    @settings(max_examples=80)
    @given(st.data())
    def test_any_maps_come_back(self, data: st.DataObject) -> None:
        rng = np.random.default_rng(data.draw(st.integers(0, 1 << 20)))
        regions, size = data.draw(st.integers(2, 40)), (data.draw(st.integers(1, 40)), data.draw(st.integers(1, 40)))
        maps: Maps = []
        for _ in range(3):
            predicted, other = random_map(rng, size, regions), random_map(rng, size, regions)
            few = np.where(rng.random(size) < 0.02, other, predicted)
            maps.append((predicted, (predicted, other, few, np.roll(predicted, 1, 1))[rng.integers(4)]))
        roundtrip(regions, maps)

    @pytest.mark.parametrize("size", [(1, 1), (1, 400), (400, 1), (2, 3)])
    def test_narrow_maps(self, size: tuple[int, int]) -> None:
        rng = np.random.default_rng(0)
        roundtrip(3, [(rng.integers(0, 3, size, np.int32), rng.integers(0, 3, size, np.int32)) for _ in range(3)])

    def test_thousands_of_regions(self) -> None:
        index = np.arange(5000, dtype=np.int32).reshape(50, 100)
        assert roundtrip(5000, [(index, np.roll(index, 1, 1)), (index, index[::-1].copy())]) < 2 * 5000 * 1.6 + 40

    def test_noise_costs_little_more_than_its_bits(self) -> None:
        rng = np.random.default_rng(1)
        first, second = rng.integers(0, 16, (2, 96, 96), np.int32)
        assert roundtrip(16, [(first, second)]) < 96 * 96 / 2 + 16

    def test_regions_vanish_and_appear(self) -> None:
        first, second = np.zeros((40, 50), np.int32), np.zeros((40, 50), np.int32)
        first[5:15, 5:20] = 1
        second[20:35, 20:40] = 2
        assert roundtrip(3, [(first, second), (second, first)]) < 60

    def test_an_unchanged_map_costs_a_byte_or_none(self) -> None:
        index = shapes(1, (480, 640)).astype(np.int32)
        assert roundtrip(6, [(index, index)]) <= 1
        assert roundtrip(6, [(index, index)] * 20) <= 2

    def test_what_was_learned_stays(self) -> None:
        index = shapes(2, (240, 320)).astype(np.int32)
        maps = [(index, np.roll(index, (1, 1), (0, 1)))] * 2
        assert roundtrip(6, maps) - roundtrip(6, maps[:1]) < 0.7 * roundtrip(6, maps[:1])

    def test_the_same_bytes_everywhere(self) -> None:
        maps = [shapes(seed).astype(np.int32) for seed in range(4)]
        data = write(6, [(a, np.roll(a, 1, 0)) for a in maps])
        assert data == write(6, [(a, np.roll(a, 1, 0)) for a in maps])
        assert hashlib.sha256(data).hexdigest()[:16] == "227edf77e07c1d7e"

    def test_refused(self) -> None:
        labels, index = FollowingLabels(2), np.zeros((2, 2), np.int32)
        with pytest.raises(ValueError, match="num_regions"):
            FollowingLabels(1)
        with pytest.raises(ValueError, match="predicted must be"):
            labels.code(Writer(), index.astype(np.int64), index)
        with pytest.raises(ValueError, match="index must hold"):
            labels.code(Writer(), index, index + 2)
        with pytest.raises(ValueError, match="index must have the size"):
            labels.code(Writer(), index, index[:1])


class TestHostile:
    @settings(max_examples=150)
    @given(st.binary(max_size=60), st.integers(2, 9), st.integers(0, 3))
    def test_any_bytes(self, data: bytes, regions: int, seed: int) -> None:
        predicted = shapes(seed, (30, 40), min(regions, 6)).astype(np.int32)
        labels, reader = FollowingLabels(regions), Reader(data)
        with suppress(CodecError):
            for _ in range(3):
                index = labels.code(reader, predicted)
                assert index.shape == predicted.shape and index.min() >= 0 and index.max() < regions

    @pytest.mark.parametrize("regions", [2, 7])
    def test_bytes_that_changed(self, regions: int) -> None:
        index = shapes(3, (120, 160)).astype(np.int32) % regions
        data, rng = write(regions, [(index, np.roll(index, 2, 1))]), np.random.default_rng(0)
        for _ in range(40):
            damaged = bytearray(data)
            damaged[rng.integers(len(data))] ^= 1 << rng.integers(8)
            with suppress(CodecError):
                FollowingLabels(regions).code(Reader(bytes(damaged)), index)

    def test_too_much_is_refused(self, monkeypatch: pytest.MonkeyPatch) -> None:
        index = shapes(3).astype(np.int32)
        data = write(6, [(index, np.roll(index, 2, 1))])
        with monkeypatch.context() as patch, pytest.raises(CodecError, match="at most 100 pixels"):
            patch.setattr(following, "_MOST_ASKED", 100)
            FollowingLabels(6).code(Reader(data), index)
        other = index.copy()
        other[50:60:3, 50:60:3] = 5 - index[50:60:3, 50:60:3]
        data = write(6, [(index, other)])
        with monkeypatch.context() as patch, pytest.raises(CodecError, match="at most 3 labels"):
            patch.setattr(following, "_MOST_LISTED", 3)
            FollowingLabels(6).code(Reader(data), index)

    def test_a_writer_gives_up_what_a_reader_refuses(self, monkeypatch: pytest.MonkeyPatch) -> None:
        index = shapes(3).astype(np.int32)
        monkeypatch.setattr(following, "_MOST_ASKED", 100)
        roundtrip(6, [(index, np.roll(index, 2, 1)), (index, index)])


class TestSettle:
    def test_jitter_is_left_out_and_change_is_kept(self) -> None:
        rng = np.random.default_rng(0)
        predicted = np.zeros((80, 100), np.int32)
        predicted[20:60, 30:60] = 1
        given = predicted.copy()
        given[20:60, 60] = rng.integers(0, 2, 40)
        given[30:50, 10:31] = 1
        settled = settle_labels(given, predicted, 2, smooth=0)
        assert np.array_equal(settled[:, 55:], predicted[:, 55:])
        assert np.array_equal(settled[32:48, 12:29], given[32:48, 12:29])
        assert np.array_equal(settle_labels(given, predicted, 0), given)
        assert np.array_equal(settle_labels(predicted, predicted, 3), predicted)

    @settings(max_examples=60)
    @given(st.data())
    def test_the_regions_of_the_given_map(self, data: st.DataObject) -> None:
        rng = np.random.default_rng(data.draw(st.integers(0, 1 << 20)))
        regions, size = data.draw(st.integers(1, 9)), (data.draw(st.integers(1, 30)), data.draw(st.integers(1, 30)))
        labels, predicted = random_map(rng, size, regions), random_map(rng, size, 9)
        settled = settle_labels(labels, predicted, data.draw(st.integers(0, 6)), smooth=data.draw(st.floats(0, 4)))
        assert np.array_equal(np.unique(settled), np.unique(labels))

    def test_refused(self) -> None:
        labels = np.zeros((3, 3), np.int32)
        with pytest.raises(ValueError, match="tolerance"):
            settle_labels(labels, labels, 33)
        with pytest.raises(ValueError, match="smooth"):
            settle_labels(labels, labels, 2, smooth=-1.0)
        with pytest.raises(ValueError, match="one size"):
            settle_labels(labels, labels[:2])
        with pytest.raises(ValueError, match="negative"):
            settle_labels(labels - 1, labels)
