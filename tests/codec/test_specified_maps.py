"""A decoder of label maps, written from docs/format.md alone: of the codec it reads the tables only."""

from __future__ import annotations

import binascii
import zlib
from collections.abc import Callable
from itertools import accumulate, pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from kcgs import RegionMap
from kcgs.codec import decode, encode_labels
from kcgs.codec.region_map import encode_region_map

from .chances import OF_MAPS, OF_SCENES, TEMPLATE, Model, Pixel, Prior
from .symbols import AdaptiveBit, AdaptiveSymbol, Bits, Bytes

Labels = NDArray[np.int64]
Rows = list[list[int]]

QUIET = [(-2, 0), (-1, 0), *((dx, -1) for dx in range(-2, 8)), *((dx, -2) for dx in range(-1, 4))]


class Map:
    """Sections "The wavefront", "Seeds" and "Pixels"."""

    def __init__(self, bits: Bits, height: int, width: int, regions: int, prior: Prior) -> None:
        self.bits, self.height, self.width, self.regions = bits, height, width, regions
        self.rows = [[-1] * width for _ in range(height)]
        self.front, self.met = 0, 1
        self.models = [Model(prior), Model(prior)]
        self.is_new = {True: AdaptiveBit(), False: AdaptiveBit()}
        self.is_nearest = {is_seed: [AdaptiveBit() for _ in range(3)] for is_seed in (True, False)}

    def label(self, x: int, y: int) -> int:
        if y < 0:
            last = min(self.front, self.width) - 1
            x, y = min(x, last) if x <= last + 9 else -1, 0
        if x < 0:
            return self.rows[y - 1][0] if y else 0
        return self.rows[y][min(x, self.width - 1)]

    def read(self) -> Rows:
        seeds = self.read_seeds()
        while self.front < self.width + 8 * (self.height - 1):
            self.read_front([(self.front - 8 * y, y) for y in range(self.height)], seeds)
            self.front += 1
        return self.rows

    def read_seeds(self) -> set[tuple[int, int]]:
        bits = self.bits
        seeds: set[tuple[int, int]] = set()
        is_extreme = [AdaptiveBit() for _ in range(8)]
        blocks = [(0, 0, self.height, self.width, bits.unbounded_number())]
        while blocks:
            y, x, height, width, count = blocks.pop()
            size = height * width
            if count in (0, 1, size):
                places = [bits.number(size)] if count == 1 else [*range(size if count else 0)]
                seeds |= {(x + place % width, y + place // width) for place in places}
                continue
            h, w = (height // 2, width) if height >= width else (height, width // 2)
            low, high = max(count - (size - h * w), 0), min(count, h * w)
            if high - low > 1 and not bits.adaptive_bit(is_extreme[min(count.bit_length() - 2, 7)]):
                first = low + 1 + bits.number(high - low - 1)
            else:
                first = low if low == high or not bits.number(2) else high
            rest = (y + h, x, height - h, width) if height >= width else (y, x + w, height, width - w)
            blocks += [(y, x, h, w, first), (*rest, count - first)]
        return seeds

    def read_front(self, pixels: list[tuple[int, int]], seeds: set[tuple[int, int]]) -> None:
        coded: dict[tuple[int, int], Pixel] = {}
        unknown: dict[tuple[int, int], list[int]] = {}
        for x, y in pixels:
            if not 0 <= x < self.width:
                continue
            neighbours = {self.label(x + dx, y + dy) for dx, dy in QUIET}
            if len(neighbours) > 1:
                unknown[x, y] = []
                coded[x, y] = Pixel([self.label(x + dx, y + dy) for dx, dy in TEMPLATE], self.models)
            elif (x, y) not in seeds:
                self.rows[y][x] = neighbours.pop()
            elif self.regions == 2:
                self.rows[y][x] = 1 - neighbours.pop()
            else:
                unknown[x, y] = [*neighbours]
        has_neither = self.regions > 2
        is_neither = {at: self.bits.bit(pixel.is_neither.p) if has_neither else 0 for at, pixel in coded.items()}
        is_second = {at: self.bits.bit(pixel.is_second.p) for at, pixel in coded.items()}
        for (x, y), candidates in unknown.items():
            at = (x, y)
            if at in coded and not is_neither[at]:
                self.rows[y][x] = coded[at].candidates[is_second[at]]
            else:
                self.rows[y][x] = self.read_label(x, y, candidates or coded[at].candidates, at not in coded)
        for at, pixel in coded.items():
            if has_neither:
                pixel.is_neither.learn(is_neither[at])
            if is_neither[at]:
                assert is_second[at]
            else:
                pixel.is_second.learn(is_second[at])

    def read_label(self, x: int, y: int, candidates: list[int], is_seed: bool) -> int:
        if self.met < self.regions and self.bits.adaptive_bit(self.is_new[is_seed]):
            self.met += 1
            return self.met - 1
        for label, model in zip(self.nearest(x, y, candidates), self.is_nearest[is_seed], strict=False):
            if self.bits.adaptive_bit(model):
                return label
        return self.bits.number(self.met)

    def nearest(self, x: int, y: int, candidates: list[int]) -> list[int]:
        nearest: list[int] = []
        for radius in range(1, 33):
            top = [(x + dx, y - radius) for dx in range(-radius, radius + 1)]
            for column, row in top + [(x + dx, y - dy) for dy in range(radius - 1, -1, -1) for dx in (-radius, radius)]:
                if row < -6 or not -8 <= column < self.width + 9 or column + 8 * row >= self.front:
                    continue
                label = self.label(column, row)
                if label not in candidates and label not in nearest:
                    nearest.append(label)
                    if len(nearest) == 3:
                        return nearest
        return nearest


def read_labels(data: bytes, height: int, width: int) -> Rows:
    """Section "Labels"."""
    bits = Bits(data)
    regions = read_regions(bits)
    ids = [*range(regions)]
    if bits.number(2):
        ids = read_order(bits, read_rising(regions, bits.unbounded_number))
    return read_pixels(bits, height, width, ids, OF_SCENES)


def read_regions(bits: Bits) -> int:
    length = 0
    while bits.number(2):
        length += 1
    return 1 << length | bits.plain(length)


def read_pixels(bits: Bits, height: int, width: int, ids: list[int], prior: Prior) -> Rows:
    if len(ids) == 1:
        return [[ids[0]] * width for _ in range(height)]
    if bits.bit(64):
        rows = [[bits.uniform(len(ids)) for _ in range(width)] for _ in range(height)]
    else:
        rows = Map(bits, height, width, len(ids), prior).read()
    return [[ids[label] for label in row] for row in rows]


def read_file(data: bytes) -> tuple[str, Rows]:
    """Section "A file of a label map": the type of its numbers, and its rows."""
    assert int.from_bytes(data[-4:], "big") == zlib.crc32(data[:-4])
    stream = Bytes(data[:-4])
    assert stream.take(4) == b"kcgm"
    kind, turn = divmod(stream.take(1)[0], 8)
    height, width = stream.varint(), stream.varint()
    bits = Bits(stream.data)
    ids = read_ids(bits, read_regions(bits))
    rows = read_pixels(bits, *((width, height) if turn & 4 else (height, width)), ids, OF_MAPS)
    if turn & 1:
        rows = [row[::-1] for row in rows]
    if turn & 2:
        rows = rows[::-1]
    if turn & 4:
        rows = [list(column) for column in zip(*rows, strict=True)]
    return ["bool", "uint8", "int8", "uint16", "int16", "uint32", "int32", "int64"][kind], rows


def read_ids(bits: Bits, regions: int) -> list[int]:
    rising, lengths = [*range(regions)], AdaptiveSymbol(8.0, *[1.0] * 16, *[0.125] * 47)

    def read_distance() -> int:
        (length,) = lengths.read(bits)
        return 1 << length - 1 | bits.plain(length - 1) if length else 0

    if bits.number(2):
        rising = [0, 255] if regions == 2 and bits.number(2) else read_rising(regions, read_distance)
    return read_order(bits, rising) if bits.number(2) else rising


def read_rising(regions: int, read_distance: Callable[[], int]) -> list[int]:
    return [last - 1 for last in accumulate(1 + read_distance() for _ in range(regions))]


def read_order(bits: Bits, remaining: list[int]) -> list[int]:
    return [remaining.pop(bits.number(len(remaining))) for _ in range(len(remaining))]


def read_map(data: bytes, height: int, width: int) -> tuple[Rows, dict[tuple[int, int], float]]:
    """Section "The region map": the labels, and the width of each two that are side by side."""
    stream = Bytes(data)
    rows = read_labels(stream.take(stream.varint()), height, width)
    widths = [stream.varint() / 40 for _ in range(stream.varint())]
    beside = [pair for row in rows for pair in pairwise(row)]
    beside += [pair for row, other in pairwise(rows) for pair in zip(row, other, strict=True)]
    pairs = sorted({(min(pair), max(pair)) for pair in beside if pair[0] != pair[1]})
    if len(widths) == 1:
        return rows, dict.fromkeys(pairs, widths[0])
    symbols, counts = Bits(stream.data), AdaptiveSymbol(*[1.0] * len(widths))
    places: list[int] = []
    while len(places) < len(pairs):
        places += counts.read(symbols, min(32, len(pairs) - len(places)))
    return rows, {pair: widths[place] for pair, place in zip(pairs, places, strict=True)}


def read_scene(data: bytes) -> tuple[bytes, int, int]:
    """Section "The file of a scene": its map, and the image's size."""
    stream = Bytes(data)
    assert stream.take(5) == b"kcgs\1"
    height, width, _, _, regions = (stream.varint() for _ in range(5))
    assert regions > 1
    length = stream.varint()
    layers = [(stream.varint(), stream.varint()) for _ in range(stream.varint())]
    head = data[: -len(stream.data)]
    checksum, region_map = stream.take(4), stream.take(length)
    assert int.from_bytes(checksum, "big") == zlib.crc32(head + region_map)
    for _, size in layers:
        assert binascii.crc_hqx(stream.take(size), 0) == int.from_bytes(stream.take(2), "big")
    assert not stream.data
    return region_map, height, width


def shuffled(index: Labels) -> Labels:
    rng = np.random.RandomState(len(index))
    ids = np.concatenate([2 ** np.arange(40, 63, 4), rng.choice(2**20, index.max() + 1, replace=False)])
    return rng.permutation(ids[: index.max() + 1])[index]


def cells(height: int, width: int, regions: int, seed: int = 0, noise: float = 0.0) -> Labels:
    """What is nearest to one of some places, and pixels of any other region among them."""
    rng = np.random.RandomState(seed)
    y, x = np.mgrid[:height, :width]
    places = rng.randint([height, width], size=(2 * regions, 2))
    nearest = ((y[..., None] - places[:, 0]) ** 2 + (x[..., None] - places[:, 1]) ** 2).argmin(-1) % regions
    return np.where(rng.rand(height, width) < noise, rng.randint(regions, size=(height, width)), nearest)


def blobs(regions: int) -> Labels:
    """Discs on a ground, so that most labels come up inside others."""
    rng = np.random.RandomState(3)
    y, x = np.mgrid[:45, :60]
    labels = np.zeros((45, 60), np.int64)
    for region in range(1, regions):
        labels[(y - rng.randint(45)) ** 2 + (x - rng.randint(60)) ** 2 < rng.randint(3, 12) ** 2] = region
    return labels


def points(regions: int) -> Labels:
    """Single pixels, hundreds of them, each with one label neighbours it."""
    rng = np.random.RandomState(regions)
    labels = np.zeros((45, 60), np.int64)
    labels[1::3, 2::4] = rng.randint(1, regions, size=(15, 15)) * (rng.rand(15, 15) < 0.7)
    return labels


Y, X = np.mgrid[:40, :60]
CASES = {
    "one": np.full((5, 7), 2**40),
    "disc": ((Y - 20) ** 2 + (X - 30) ** 2 < 200) * 7,
    "stripes": X // 7 % 2,
    "noise": np.random.RandomState(1).randint(5, size=(20, 30)),
    "ids": shuffled(cells(40, 60, 14)),
    "speckled": shuffled(cells(24, 44, 9, noise=0.05)),
    "two, speckled": cells(24, 44, 2, noise=0.05),
    "points": points(2),
    "points of nine": points(9),
    "blobs": blobs(14),
    "row": cells(1, 150, 5),
    # above row 0, 9 columns beyond the last pixel, lies label 0, nearer to it than any other
    "end of a row": np.repeat([0, 1, 2, 1], [200, 3, 25, 1])[None],
    # the place of its only start is a number of more than 65536
    "long row": np.eye(1, 66000, 65900),
    # what is above the map, and to its right, decides much here
    **{f"low {seed}": cells(1 + seed % 4, 40, 9, seed, noise=0.02) for seed in (1, 3)},
}


@pytest.mark.parametrize("name", CASES)
def test_labels_of_a_scene(name: str) -> None:
    check_map(RegionMap(torch.from_numpy(np.asarray(CASES[name], np.int64))))


@pytest.mark.parametrize("name", ["one", "disc", "noise", "ids", "two, speckled", "points of nine", "row"])
def test_labels_of_a_file(name: str) -> None:
    labels = np.asarray(CASES[name], np.int64)
    assert read_file(encode_labels(labels)) == ("int64", labels.tolist())


@pytest.mark.parametrize(
    ("ids", "kind"),
    [([0, 255], "uint8"), ([255, 0], "uint8"), ([0, 1], "int32"), ([7, 9], "int32"), ([9, 1, 200, 3, 254], "uint8")],
)
def test_ids_of_files(ids: list[int], kind: str) -> None:
    labels = np.array(ids, kind)[cells(20, 30, len(ids))]
    assert read_file(encode_labels(labels)) == (kind, labels.tolist())


def check_map(regions: RegionMap, data: bytes | None = None) -> None:
    rows, widths = read_map(data or encode_region_map(regions), *regions.size)
    assert np.array_equal(rows, regions.labels.numpy())
    soft = regions.softness
    assert widths == {pair: soft if isinstance(soft, float) else soft.get(pair, 0.0) for pair in widths}


class TestWidths:
    @pytest.mark.parametrize("softness", [0.0, 0.75])
    def test_one(self, softness: float) -> None:
        check_map(RegionMap(torch.from_numpy(cells(20, 30, 3)), softness))

    def test_of_each_pair(self) -> None:
        labels = torch.from_numpy(shuffled(cells(40, 60, 24)))
        ids = labels.unique().tolist()
        pairs = [(a, b) for a in ids for b in ids if a < b]
        widths = {pair: (0.0, 0.5, 0.5, 1.25)[i % 4] for i, pair in enumerate(pairs)}
        check_map(RegionMap(labels, widths))


def test_golden() -> None:
    data = (Path(__file__).parent / "golden.kcgs").read_bytes()
    regions = decode(data).scene.regions
    assert regions is not None
    region_map, height, width = read_scene(data)
    assert (height, width) == regions.size
    check_map(regions, region_map)
