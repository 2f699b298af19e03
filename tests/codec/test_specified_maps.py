"""A decoder of label maps, written from the words of docs/format.md: plain numbers, and of the codec only its table."""

from __future__ import annotations

import binascii
import zlib
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from kcgs import RegionMap, codec
from kcgs.codec import decode
from kcgs.codec.labels import encode_labels, encode_map

from .chances import OF_MAPS, OF_SCENES, TEMPLATE, Decision, Pixel, Prior
from .symbols import Bits, Bytes, Choices, Learnt, Symbols

Labels = NDArray[np.int64]
Rows = list[list[int]]

QUIET = [(-2, 0), (-1, 0), *((dx, -1) for dx in range(-2, 8)), *((dx, -2) for dx in range(-1, 4))]


class Map:
    """Labels: from the wavefront to pixels."""

    def __init__(self, bits: Bits, height: int, width: int, regions: int, prior: Prior = OF_SCENES) -> None:
        self.bits, self.height, self.width, self.regions = bits, height, width, regions
        self.rows = [[-1] * width for _ in range(height)]
        self.wave, self.met = 0, 1
        self.decisions = [Decision(prior), Decision(prior)]
        self.new = {True: Learnt(), False: Learnt()}
        self.near = {start: [Learnt() for _ in range(3)] for start in (True, False)}

    def label(self, x: int, y: int) -> int:
        if y < 0:
            last = min(self.wave, self.width) - 1
            x, y = min(x, last) if x <= last + 9 else -1, 0
        if x < 0:
            return self.rows[y - 1][0] if y else 0
        return self.rows[y][min(x, self.width - 1)]

    def read(self) -> Rows:
        starts = self.read_starts()
        while self.wave < self.width + 8 * (self.height - 1):
            self.read_wave([(self.wave - 8 * y, y) for y in range(self.height)], starts)
            self.wave += 1
        return self.rows

    def read_starts(self) -> set[tuple[int, int]]:
        bits = self.bits
        starts: set[tuple[int, int]] = set()
        extreme = [Learnt() for _ in range(8)]
        blocks = [(0, 0, self.height, self.width, bits.magnitude())]
        while blocks:
            y, x, height, width, count = blocks.pop()
            size = height * width
            if count in (0, 1, size):
                places = [bits.number(size)] if count == 1 else [*range(size if count else 0)]
                starts |= {(x + place % width, y + place // width) for place in places}
                continue
            h, w = (height // 2, width) if height >= width else (height, width // 2)
            low, high = max(count - (size - h * w), 0), min(count, h * w)
            if high - low > 1 and not bits.learnt(extreme[min(count.bit_length() - 2, 7)]):
                first = low + 1 + bits.number(high - low - 1)
            else:
                first = low if low == high or not bits.number(2) else high
            rest = (y + h, x, height - h, width) if height >= width else (y, x + w, height, width - w)
            blocks += [(y, x, h, w, first), (*rest, count - first)]
        return starts

    def read_wave(self, pixels: list[tuple[int, int]], starts: set[tuple[int, int]]) -> None:
        unquiet: dict[tuple[int, int], Pixel] = {}
        unknown: dict[tuple[int, int], list[int]] = {}
        for x, y in pixels:
            if not 0 <= x < self.width:
                continue
            around = {self.label(x + dx, y + dy) for dx, dy in QUIET}
            if len(around) > 1:
                unknown[x, y] = []
                unquiet[x, y] = Pixel([self.label(x + dx, y + dy) for dx, dy in TEMPLATE], self.decisions)
            elif (x, y) not in starts:
                self.rows[y][x] = around.pop()
            elif self.regions == 2:
                self.rows[y][x] = 1 - around.pop()
            else:
                unknown[x, y] = [*around]
        three = self.regions > 2
        neither = {at: self.bits.bit(pixel.neither.p) if three else 0 for at, pixel in unquiet.items()}
        which = {at: self.bits.bit(pixel.which.p) for at, pixel in unquiet.items()}
        for (x, y), candidates in unknown.items():
            at = (x, y)
            if at in unquiet and not neither[at]:
                self.rows[y][x] = unquiet[at].candidates[which[at]]
            else:
                self.rows[y][x] = self.read_label(x, y, candidates or unquiet[at].candidates, at not in unquiet)
        for at, pixel in unquiet.items():
            if three:
                pixel.neither.learn(neither[at])
            if neither[at]:
                assert which[at]
            else:
                pixel.which.learn(which[at])

    def read_label(self, x: int, y: int, candidates: list[int], start: bool) -> int:
        if self.met < self.regions and self.bits.learnt(self.new[start]):
            self.met += 1
            return self.met - 1
        for label, model in zip(self.nearest(x, y, candidates), self.near[start], strict=False):
            if self.bits.learnt(model):
                return label
        return self.bits.number(self.met)

    def nearest(self, x: int, y: int, candidates: list[int]) -> list[int]:
        found: list[int] = []
        for radius in range(1, 33):
            top = [(x + dx, y - radius) for dx in range(-radius, radius + 1)]
            for column, row in top + [(x + dx, y - dy) for dy in range(radius - 1, -1, -1) for dx in (-radius, radius)]:
                if row < -6 or not -8 <= column < self.width + 9 or column + 8 * row >= self.wave:
                    continue
                label = self.label(column, row)
                if label not in candidates and label not in found:
                    found.append(label)
                    if len(found) == 3:
                        return found
        return found


def read_labels(data: bytes, height: int, width: int) -> Rows:
    """`labels`, **Regions** and **Noise**."""
    bits = Bits(data)
    regions = read_regions(bits)
    ids = [*range(regions)]
    if bits.number(2):
        left, last = [], -1
        for _ in range(regions):
            last += 1 + bits.magnitude()
            left.append(last)
        ids = [left.pop(bits.number(len(left))) for _ in range(regions)]
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
    """`A file of a label map`: the type of its numbers, and its rows."""
    assert int.from_bytes(data[-4:], "big") == zlib.crc32(data[:-4])
    stream = Bytes(data[:-4])
    assert stream.take(4) == b"kcgm"
    (form,) = stream.take(1)
    turn, kind = form % 8, form // 8
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
    left = [*range(regions)]
    if bits.number(2):
        if regions == 2 and bits.number(2):
            left = [0, 255]
        else:
            left, last, lengths = [], -1, Choices(8.0, *[1.0] * 16, *[0.125] * 47)
            for _ in range(regions):
                (length,) = lengths.read(bits)
                last += 1 + (1 << length - 1 | bits.plain(length - 1) if length else 0)
                left.append(last)
    return [left.pop(bits.number(len(left))) for _ in range(regions)] if bits.number(2) else left


def read_map(data: bytes, height: int, width: int) -> tuple[Rows, dict[tuple[int, int], float]]:
    """`maps`: the labels, and the width of each two that are side by side."""
    stream = Bytes(data)
    rows = read_labels(stream.take(stream.varint()), height, width)
    widths = [stream.varint() / 40 for _ in range(stream.varint())]
    beside = [pair for row in rows for pair in pairwise(row)]
    beside += [pair for row, other in pairwise(rows) for pair in zip(row, other, strict=True)]
    pairs = sorted({(min(pair), max(pair)) for pair in beside if pair[0] != pair[1]})
    if len(widths) == 1:
        return rows, dict.fromkeys(pairs, widths[0])
    symbols, counts = Symbols(stream.data), Choices(*[1.0] * len(widths))
    places: list[int] = []
    while len(places) < len(pairs):
        places += counts.read(symbols, min(32, len(pairs) - len(places)))
    return rows, {pair: widths[place] for pair, place in zip(pairs, places, strict=True)}


def map_of(data: bytes) -> tuple[bytes, int, int]:
    """`stream`: a file's map, and the picture's size."""
    stream = Bytes(data)
    assert stream.take(5) == b"kcgs\1"
    height, width, _, _, regions = (stream.varint() for _ in range(5))
    assert regions > 1
    length = stream.varint()
    layers = [(stream.varint(), stream.varint()) for _ in range(stream.varint())]
    above = data[: -len(stream.data)]
    check, found = stream.take(4), stream.take(length)
    assert int.from_bytes(check, "big") == zlib.crc32(above + found)
    for _, size in layers:
        assert binascii.crc_hqx(stream.take(size), 0) == int.from_bytes(stream.take(2), "big")
    assert not stream.data
    return found, height, width


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
    y, x = np.mgrid[:60, :90]
    labels = np.zeros((60, 90), np.int64)
    for region in range(1, regions):
        labels[(y - rng.randint(60)) ** 2 + (x - rng.randint(90)) ** 2 < rng.randint(3, 12) ** 2] = region
    return labels


def points(regions: int) -> Labels:
    """Single pixels, hundreds of them, each with one label around it."""
    rng = np.random.RandomState(regions)
    labels = np.zeros((60, 90), np.int64)
    labels[1::3, 2::4] = rng.randint(1, regions, size=(20, 22)) * (rng.rand(20, 22) < 0.7)
    return labels


Y, X = np.mgrid[:40, :60]
ROW = cells(1, 150, 5)
CASES = {
    "one": np.full((5, 7), 2**40),
    "disc": ((Y - 20) ** 2 + (X - 30) ** 2 < 200) * 7,
    "stripes": X // 7 % 2,
    "noise": np.random.RandomState(1).randint(5, size=(20, 30)),
    "cells": cells(60, 90, 14),
    "ids": shuffled(cells(40, 60, 14)),
    "speckled": shuffled(cells(24, 44, 9, noise=0.05)),
    "two, speckled": cells(24, 44, 2, noise=0.05),
    "points": points(2),
    "points of nine": points(9),
    "blobs": blobs(14),
    "row": ROW,
    "column": ROW.T,
    # above row 0, 9 columns beyond the last pixel, lies label 0, nearer to it than any other
    "end of a row": np.repeat([0, 1, 2, 1], [200, 3, 25, 1])[None],
    # the place of its only start is a number of more than 65536
    "long row": np.eye(1, 66000, 65900),
}


@pytest.mark.parametrize("name", CASES)
def test_labels(name: str) -> None:
    labels = np.asarray(CASES[name], np.int64)
    assert np.array_equal(read_labels(encode_labels(labels), *labels.shape), labels)


@pytest.mark.parametrize("name", CASES)
def test_files(name: str) -> None:
    labels = np.asarray(CASES[name], np.int64)
    assert read_file(codec.encode_labels(labels)) == ("int64", labels.tolist())


@pytest.mark.parametrize("ids", [[0, 255], [255, 0], [0, 1], [1, 0], [7, 9], [0, 3, 2, 1, 5], [9, 1, 200, 3, 254]])
@pytest.mark.parametrize("kind", ["uint8", "uint16", "int32"])
def test_ids_of_files(ids: list[int], kind: str) -> None:
    labels = np.array(ids, kind)[cells(20, 30, len(ids))]
    assert read_file(codec.encode_labels(labels)) == (kind, labels.tolist())


@pytest.mark.parametrize("seed", range(12))
def test_low_maps(seed: int) -> None:
    # what is above the map, and to its right, decides much here
    labels = cells(1 + seed % 4, 40, 9, seed, noise=0.02)
    assert np.array_equal(read_labels(encode_labels(labels), *labels.shape), labels)


def check_map(regions: RegionMap, data: bytes) -> None:
    rows, widths = read_map(data, *regions.size)
    assert np.array_equal(rows, regions.labels.numpy())
    soft = regions.softness
    assert widths == {pair: soft if isinstance(soft, float) else soft.get(pair, 0.0) for pair in widths}


@pytest.mark.parametrize("softness", [0.0, 0.75])
def test_map(softness: float) -> None:
    regions = RegionMap.from_labels(torch.from_numpy(cells(20, 30, 3)), softness)
    check_map(regions, encode_map(regions))


def test_widths() -> None:
    labels = torch.from_numpy(shuffled(cells(40, 60, 24)))
    ids = labels.unique().tolist()
    pairs = [(a, b) for a in ids for b in ids if a < b]
    regions = RegionMap.from_labels(labels, {pair: (0.0, 0.5, 0.5, 1.25)[i % 4] for i, pair in enumerate(pairs)})
    check_map(regions, encode_map(regions))


def test_golden() -> None:
    data = (Path(__file__).parent / "golden.kcgs").read_bytes()
    regions = decode(data).scene.regions
    assert regions is not None
    found, height, width = map_of(data)
    assert (height, width) == regions.size
    check_map(regions, found)
