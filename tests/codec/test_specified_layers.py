"""A decoder of layers, written from the words of docs/format.md: plain numbers, and of the codec only its tables."""

from __future__ import annotations

import bisect
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from kcgs.codec import Decoded, decode, encode
from kcgs.codec.exact import exp2, turn
from kcgs.codec.file import Header, unpack
from kcgs.codec.gaussians.layers import _GREY, _HUE, _HUE2, _RATIO
from kcgs.codec.gaussians.quantize import opponent

from .conftest import make_scene
from .symbols import Choices, Symbols

LN2 = 0.6931471805599453
BUCKETS = [
    *range(16),
    *((1 << octave) + ((1 << octave) // 8) * i for octave in range(4, 24) for i in range(8)),
    1 << 24,
]


class Magnitudes:
    def __init__(self, table: Any, contexts: int = 1) -> None:
        self.shapes = [[0.05 * float(value) for value in table] for _ in range(contexts)]

    @staticmethod
    def weights(shape: list[float], t: float) -> list[float]:
        heights = [0.0]
        for value in shape:
            heights.append(heights[-1] + value)
        edges = [i * (t * 0.125) for i in range(25)]

        def rise(x: float) -> float:
            i = min(max(bisect.bisect(edges, x) - 1, 0), 23)
            share = min(max((x - edges[i]) / (edges[i + 1] - edges[i]), 0.0), 1.0)
            return heights[i] + share * (heights[i + 1] - heights[i])

        at = [rise(max(bucket - 0.5, 0.0)) for bucket in BUCKETS]
        return [(at[i + 1] - at[i]) + 0.001 * heights[-1] / 176 for i in range(176)]

    def read(self, symbols: Symbols, t: float, contexts: list[int]) -> list[int]:
        tables = [self.weights(shape, t) for shape in self.shapes]
        buckets = [symbols.categorical(tables[context]) for context in contexts]
        sizes = [BUCKETS[b] + symbols.uniform(BUCKETS[b + 1] - BUCKETS[b]) for b in buckets]
        edges = [*(i * (t * 0.125) for i in range(24)), math.inf]
        learned = [[0] * 24 for _ in self.shapes]
        for context, size in zip(contexts, sizes, strict=True):
            low, high = max(size - 0.5, 0.0), size + 0.5
            for i in range(24):
                covered = max(min(high, edges[i + 1]) - max(low, edges[i]), 0.0)
                learned[context][i] += math.floor(covered / (high - low) * 256 + 0.5)
        for shape, parts in zip(self.shapes, learned, strict=True):
            shape[:] = [value + part / 256 for value, part in zip(shape, parts, strict=True)]
        return sizes


def power(x: float) -> float:
    return float(exp2(np.array([x]))[0])


class File:
    """Gaussians."""

    def __init__(self, header: Header, index: Any, regions: int) -> None:
        self.size, self.channels, self.index, self.regions = header.size, header.channels, index, regions
        self.distortion = power(-header.qp / 32)
        self.lengths = Choices(2.0, *[1.0] * 9, *[0.3] * 12)
        self.margins = Choices(3.0, *[1.0] * 4, *[0.3] * 4)
        self.strays = Choices(20.0, 0.5)
        self.colors = [Magnitudes(_GREY), Magnitudes(_HUE, 3), Magnitudes(_HUE2, 3)]
        self.ratio = Magnitudes(_RATIO)
        self.outside, self.seen = 0.5, 20

    def read_length(self, symbols: Symbols, choices: Choices) -> int:
        bits = choices.read(symbols)[0]
        return (1 << (bits - 1)) + symbols.uniform(1 << (bits - 1)) if bits else 0

    def fill(self, symbols: Symbols, rate: float, cells: int) -> list[int]:
        p = rate / (1 + rate)
        weights = [1 - p]
        for _ in range(7):
            weights.append(weights[-1] * p)
        weights[7] /= 1 - p
        held = [symbols.categorical(weights) for _ in range(cells)]
        full = [i for i in range(cells) if held[i] == 7]
        while full:
            more = [symbols.categorical(weights) for _ in full]
            for i, count in zip(full, more, strict=True):
                held[i] += count
            full = [i for i, count in zip(full, more, strict=True) if count == 7]
        return held

    def side(self, count: int) -> int:
        q = self.size[0] * self.size[1] // (16 * count)
        return int(2 ** (math.floor(math.log2(q) / 2))) if q else 1

    def cells(self, symbols: Symbols, count: int) -> list[tuple[int, int]]:
        side = self.side(count)
        rows, columns = (math.ceil(pixels / side) for pixels in self.size)
        m = self.read_length(symbols, self.margins)
        f = self.outside / self.seen if m else 0.0
        every = [(row, column) for row in range(-m, rows + m) for column in range(-m, columns + m)]
        inside = [at for at in every if 0 <= at[0] < rows and 0 <= at[1] < columns]
        beyond = [at for at in every if at not in set(inside)]
        held = dict(zip(inside, self.fill(symbols, max(count * (1 - f), 0.01) / len(inside), len(inside)), strict=True))
        if m:
            told = self.fill(symbols, max(count * f, 0.01) / len(beyond), len(beyond))
            held |= dict(zip(beyond, told, strict=True))
            self.outside += sum(told)
            self.seen += count
        return [at for at in sorted(held) for _ in range(held[at])]

    def layer(self, symbols: Symbols, e: int) -> list[tuple[list[float], int]]:
        first = symbols.uniform(64)
        last = first + symbols.uniform(64 - first)
        counts = {s - 8: self.read_length(symbols, self.lengths) for s in range(first, last + 1)}
        kinds = [(s, *at) for s in sorted(counts, reverse=True) if counts[s] for at in self.cells(symbols, counts[s])]
        u = math.sqrt(12 * self.distortion / math.pi * power(-2 * e - 1))
        scales = min(max(math.floor(0.75 / (u * (math.sqrt(0.5) / LN2)) + 0.5), 1), 2**20)
        step = max(u * (1 / LN2), 12 / 2**20)
        scale = [symbols.uniform(scales) for _ in kinds]
        ratio = self.ratio.read(symbols, 2 / step, [0] * len(kinds))
        stretch = [0.5 * (power(2 * r * step) - power(-2 * r * step)) for r in ratio]
        turns = [
            min(max(math.floor(math.pi * s / u + 0.5), 2), 2**20) if r else 1
            for s, r in zip(stretch, ratio, strict=True)
        ]
        angle = [symbols.uniform(n) for n in turns]
        colors = self.read_colors(symbols, e, len(kinds))
        shapes, parts, sides = [], [], []
        for i, (s, _, _) in enumerate(kinds):
            m, h = 0.75 * (s + (scale[i] + 0.5) / scales), ratio[i] * step
            one, two = power(m + h), power(m - h)
            cos, sin = (float(t[0]) for t in turn(np.array([angle[i] / turns[i]])))
            l11 = math.sqrt((one * cos) * (one * cos) + (two * sin) * (two * sin))
            shapes.append([l11, (one * one - two * two) * cos * sin / l11, one * two / l11])
            sides.append(self.side(counts[s]))
            places = (math.ceil(sides[i] / (u * math.sqrt(2) * length)) for length in shapes[i][::2])
            parts.append([min(max(n, 1), 2**20) for n in places])
        across, down = ([symbols.uniform(part[axis]) for part in parts] for axis in range(2))
        found = []
        for i, (s, row, column) in enumerate(kinds):
            x = np.float32(sides[i] * (column + (across[i] + 0.5) / parts[i][0]))
            y = np.float32(sides[i] * (row + (down[i] + 0.5) / parts[i][1]))
            area = min(math.pi * power(1.5 * (s + 0.5)), float(self.size[0] * self.size[1]))
            told = np.array([colors[i]]) * math.sqrt(12 * self.distortion / area)
            found.append([x, y, *shapes[i], *opponent(told, back=True)[0]])
        return list(zip(found, self.read_regions(symbols, found), strict=True))

    def read_colors(self, symbols: Symbols, e: int, count: int) -> list[list[int]]:
        loud = math.sqrt(math.pi / (12 * self.distortion)) * 2.0**e
        colors: list[list[int]] = [[] for _ in range(count)]
        for channel in range(self.channels):
            contexts = [(abs(c[-1]) > 0.35 * loud) + (abs(c[-1]) > 0.8 * loud) if channel else 0 for c in colors]
            sizes = self.colors[min(channel, 2)].read(symbols, loud, contexts)
            signs = [symbols.uniform(2 if size else 1) for size in sizes]
            for color, size, sign in zip(colors, sizes, signs, strict=True):
                color.append(-size if sign else size)
        return colors

    def read_regions(self, symbols: Symbols, found: list[list[float]]) -> list[int]:
        if self.regions == 1:
            return [0] * len(found)
        height, width = self.size
        at = [(min(max(math.floor(y), 0), height - 1), min(max(math.floor(x), 0), width - 1)) for x, y, *_ in found]
        ids = [int(self.index[place]) for place in at]
        strays = [i for i, stray in enumerate(self.strays.read(symbols, len(ids))) if stray]
        for i in strays:
            ids[i] = (ids[i] + 1 + symbols.uniform(self.regions - 1)) % self.regions
        return ids


def as_the_words_say(data: bytes, known: Decoded) -> None:
    header, _, layers = unpack(data)
    field, regions = known.scene.field, known.scene.regions
    index = None if regions is None else regions.index_of(regions.labels).numpy()
    file = File(header, index, header.regions)
    found = [
        row
        for (energy, _), layer in zip(header.layers, layers, strict=True)
        for row in file.layer(Symbols(layer), energy)
    ]
    expected = torch.cat([field.means, field.cholesky, field.colors], -1).detach().numpy()
    assert np.array_equal(np.array([numbers for numbers, _ in found]).astype(np.float32), expected)
    if regions is not None:
        assert field.region_ids is not None
        assert [id for _, id in found] == regions.index_of(field.region_ids).tolist()


@pytest.mark.parametrize("name", ["golden.kcgs", "golden2.kcgs"])
def test_golden(name: str) -> None:
    data = (Path(__file__).parent / name).read_bytes()
    as_the_words_say(data, decode(data))


@pytest.mark.parametrize(("regions", "channels", "quality"), [(1, 1, 20.0), (3, 3, 50.0), (2, 4, 80.0)])
def test_others(regions: int, channels: int, quality: float) -> None:
    data = encode(make_scene(120, regions=regions, channels=channels, seed=3), quality=quality)
    as_the_words_say(data, decode(data))
