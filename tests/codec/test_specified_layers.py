"""A decoder of layers, written from docs/format.md alone: of the codec it reads tables and elementary functions."""

from __future__ import annotations

import bisect
import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from kcgs.codec import decode, encode
from kcgs.codec.exact import cos_sin, exp2
from kcgs.codec.file import Header, unpack
from kcgs.codec.gaussians import occupancy
from kcgs.codec.gaussians.quantize import opponent
from kcgs.codec.gaussians.shapes import ANGLE, SHAPES
from kcgs.codec.rangecoder import Writer

from .conftest import make_scene
from .symbols import AdaptiveSymbol, Bits

LN2 = 0.6931471805599453
BAND = 65536  # cells
BUCKETS = [
    *range(16),
    *((1 << octave) + ((1 << octave) // 8) * i for octave in range(4, 24) for i in range(8)),
    1 << 24,
]


class Magnitudes:
    def __init__(self, shapes: Any) -> None:
        self.shapes = shapes.tolist()

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

        sums = [rise(max(bucket - 0.5, 0.0)) for bucket in BUCKETS]
        return [(sums[i + 1] - sums[i]) + 0.001 * heights[-1] / 176 for i in range(176)]

    def read(self, bits: Bits, scales: list[float], contexts: list[int]) -> list[int]:
        kinds = list(zip(contexts, scales, strict=True))
        tables = {(context, t): self.weights(self.shapes[context], t) for context, t in set(kinds)}
        buckets = [bits.categorical(tables[kind]) for kind in kinds]
        sizes = [BUCKETS[b] + bits.uniform(BUCKETS[b + 1] - BUCKETS[b]) for b in buckets]
        learned = [[0] * 24 for _ in self.shapes]
        for (context, t), size in zip(kinds, sizes, strict=True):
            edges = [*(i * (t * 0.125) for i in range(24)), math.inf]
            low, high = max(size - 0.5, 0.0), size + 0.5
            for i in range(24):
                covered = max(min(high, edges[i + 1]) - max(low, edges[i]), 0.0)
                learned[context][i] += math.floor(covered / (high - low) * 256 + 0.5)
        for shape, parts in zip(self.shapes, learned, strict=True):
            shape[:] = [value + part / 256 for value, part in zip(shape, parts, strict=True)]
        return sizes


class Angles:
    def __init__(self) -> None:
        self.weights = ANGLE.tolist()

    def read(self, bits: Bits, num_angles: list[int]) -> list[int]:
        begins = [[b * t // 16 for b in range(17)] for t in num_angles]
        bins = [
            bits.categorical([w * (begin[b + 1] - begin[b]) for b, w in enumerate(self.weights)]) if t >= 16 else -1
            for t, begin in zip(num_angles, begins, strict=True)
        ]
        angles = []
        for t, begin, b in zip(num_angles, begins, bins, strict=True):
            if t < 16:
                angles.append(bits.uniform(t))
            else:
                angles.append((begin[b] + bits.uniform(begin[b + 1] - begin[b]) - t // 32) % t)
                self.weights[b] += 1
        return angles


def power(x: float) -> float:
    return float(exp2(np.array([x]))[0])


def read_number(bits: Bits, lengths: AdaptiveSymbol) -> int:
    length = lengths.read(bits)[0]
    return (1 << (length - 1)) + bits.uniform(1 << (length - 1)) if length else 0


class Occupancy:
    def __init__(self, size: tuple[int, int]) -> None:
        self.size = size
        self.margins = AdaptiveSymbol(3.0, *[1.0] * 4, *[0.3] * 4)
        self.outside = AdaptiveSymbol(0.3, *[1.0] * 4, *[0.3] * 17)
        self.earlier: list[tuple[int, float, float]] = []  # the class of size, and the middle of the cell

    def side(self, count: int) -> int:
        q = self.size[0] * self.size[1] // (16 * count)
        return int(2 ** (math.floor(math.log2(q) / 2))) if q else 1

    def read(self, bits: Bits, s: int, count: int) -> list[tuple[int, int]]:
        side = self.side(count)
        rows, columns = (math.ceil(pixels / side) for pixels in self.size)
        m = read_number(bits, self.margins)
        cells = [(row, column) for row in range(-m, rows + m) for column in range(-m, columns + m)]
        inside = [cell for cell in cells if 0 <= cell[0] < rows and 0 <= cell[1] < columns]
        outside = sorted({*cells} - {*inside})
        counts = self.read_cells(bits, s, count, rows, inside, outside)
        occupied = [cell for cell in sorted(counts) for _ in range(counts[cell])]
        self.earlier += [(s, (row + 0.5) * side, (column + 0.5) * side) for row, column in occupied]
        return occupied

    def read_cells(self, bits: Bits, s: int, count: int, rows: int, inside: Any, outside: Any) -> dict[Any, int]:
        num_outside = read_number(bits, self.outside) if outside else 0
        bands = max(8, math.ceil(len(inside) / BAND))
        borders = [rows * i // bands * (len(inside) // rows) for i in range(bands + 1)]
        counts = self.fill(bits, count - num_outside, self.weigh(s, self.side(count), inside), borders)
        bands = max(8, math.ceil(len(outside) / BAND))
        borders = [len(outside) * i // bands for i in range(bands + 1)]
        return counts | self.fill(bits, num_outside, dict.fromkeys(outside, 1), borders)

    def weigh(self, s: int, side: int, inside: Any) -> dict[tuple[int, int], int]:
        def mirror(place: int, cells: int) -> int:
            while not 0 <= place < cells:
                place = -1 - place if place < 0 else 2 * cells - 1 - place
            return place

        rows, columns = inside[-1][0] + 1, inside[-1][1] + 1
        weights = dict.fromkeys(inside, max(480000 // len(inside), 1))
        for other, y, x in self.earlier:
            row, column = math.floor(y / side), math.floor(x / side)
            if other in (s, s + 1, s + 2) and (row, column) in weights:
                for dy in range(-4, 5):
                    for dx in range(-4, 5):
                        cell = mirror(row + dy, rows), mirror(column + dx, columns)
                        weights[cell] += 64 * (5 - abs(dx)) * (5 - abs(dy))
        return weights

    def fill(self, bits: Bits, left: int, weights: dict[Any, int], borders: list[int]) -> dict[Any, int]:
        counts, cells, total = dict.fromkeys(weights, 0), list(weights), sum(weights.values())
        for start, end in itertools.pairwise(borders):
            chances = {}
            for cell in cells[start:end] if left else []:
                chance = math.floor(65536 * (left * weights[cell]) / (left * weights[cell] + total))
                chances[cell] = min(max(chance, 16), 65520)
            band = list(chances)
            while band := [cell for cell in band if bits.bit(chances[cell])]:
                for cell in band:
                    counts[cell] += 1
                left -= len(band)
            total -= sum(weights[cell] for cell in cells[start:end])
        return counts


class File:
    """Section "The stream of a layer"."""

    def __init__(self, header: Header, index: Any, regions: int) -> None:
        self.size, self.channels, self.index, self.regions = header.size, header.channels, index, regions
        self.distortion = power(-header.qp / 32)
        self.lengths = AdaptiveSymbol(2.0, *[1.0] * 9, *[0.3] * 12)
        self.strays = AdaptiveSymbol(20.0, 0.5)
        *self.colors, self.ratio = (Magnitudes(shapes) for shapes in SHAPES)
        self.angles = Angles()
        self.occupancy = Occupancy(header.size)

    def layer(self, bits: Bits, e: int) -> list[tuple[list[float], int]]:
        gaussians, symbol = self.group(bits, e), bits.number(3)
        while symbol:
            e -= 1
            assert e >= -24
            if symbol == 1:
                gaussians += self.group(bits, e)
            symbol = bits.number(3)
        return gaussians

    def group(self, bits: Bits, e: int) -> list[tuple[list[float], int]]:
        first = bits.uniform(64)
        last = first + bits.uniform(64 - first)
        counts = {s - 8: read_number(bits, self.lengths) for s in range(first, last + 1)}
        classes = [s for s in sorted(counts, reverse=True) if counts[s]]
        kinds = [(s, *cell) for s in classes for cell in self.occupancy.read(bits, s, counts[s])]
        u = math.sqrt(12 * self.distortion / math.pi * power(-2 * e - 1))
        scales = min(max(math.floor(0.75 / (u * (math.sqrt(0.5) / LN2)) + 0.5), 1), 2**20)
        step = max(u * (1 / LN2), 12 / 2**20)
        scale = [bits.uniform(scales) for _ in kinds]
        contexts = [min(max(s + 1, 0), 7) for s, _, _ in kinds]
        ratio = self.ratio.read(bits, [2 / step] * len(kinds), contexts)
        stretch = [0.5 * (power(2 * r * step) - power(-2 * r * step)) for r in ratio]
        num_angles = [
            min(max(math.floor(math.pi * s / u + 0.5), 2), 2**20) if r else 1
            for s, r in zip(stretch, ratio, strict=True)
        ]
        angle = self.angles.read(bits, num_angles)
        colors = self.read_colors(bits, e, [(8 * one + 4) // scales for one in scale])
        shapes, parts, sides = [], [], []
        for i, (s, _, _) in enumerate(kinds):
            m, h = 0.75 * (s + (scale[i] + 0.5) / scales), ratio[i] * step
            one, two = power(m + h), power(m - h)
            cos, sin = (float(t[0]) for t in cos_sin(np.array([angle[i] / num_angles[i]])))
            l11 = math.sqrt((one * cos) * (one * cos) + (two * sin) * (two * sin))
            shapes.append([l11, (one * one - two * two) * cos * sin / l11, one * two / l11])
            sides.append(self.occupancy.side(counts[s]))
            places = (math.ceil(sides[i] / (u * math.sqrt(2) * length)) for length in shapes[i][::2])
            parts.append([min(max(n, 1), 2**20) for n in places])
        across, down = ([bits.uniform(part[axis]) for part in parts] for axis in range(2))
        gaussians = []
        for i, (s, row, column) in enumerate(kinds):
            x = np.float32(sides[i] * (column + (across[i] + 0.5) / parts[i][0]))
            y = np.float32(sides[i] * (row + (down[i] + 0.5) / parts[i][1]))
            area = min(math.pi * power(1.5 * (s + 0.5)), float(self.size[0] * self.size[1]))
            color = np.array([colors[i]]) * math.sqrt(12 * self.distortion / area)
            gaussians.append([x, y, *shapes[i], *opponent(color, inverse=True)[0]])
        return list(zip(gaussians, self.read_regions(bits, gaussians), strict=True))

    def read_colors(self, bits: Bits, e: int, levels: list[int]) -> list[list[int]]:
        loud = math.sqrt(math.pi / (12 * self.distortion)) * 2.0**e
        scales = [loud * power(0.75 * (0.5 - (v + 0.5) / 8)) for v in levels]
        colors: list[list[int]] = [[] for _ in levels]
        for channel in range(self.channels):
            contexts = [0] * len(levels)
            if channel:
                sizes = [abs(color[-1]) for color in colors]
                contexts = [(a > 0.35 * t) + (a > 0.8 * t) for a, t in zip(sizes, scales, strict=True)]
            sizes = self.colors[min(channel, 2)].read(bits, scales, contexts)
            signs = [bits.uniform(2 if size else 1) for size in sizes]
            for color, size, sign in zip(colors, sizes, signs, strict=True):
                color.append(-size if sign else size)
        return colors

    def read_regions(self, bits: Bits, gaussians: list[list[float]]) -> list[int]:
        if self.regions == 1:
            return [0] * len(gaussians)
        rows, columns = (
            [min(max(math.floor(g[1 - axis]), 0), self.size[axis] - 1) for g in gaussians] for axis in (0, 1)
        )
        ids = self.index[rows, columns].tolist()
        strays = [i for i, stray in enumerate(self.strays.read(bits, len(ids))) if stray]
        for i in strays:
            ids[i] = (ids[i] + 1 + bits.uniform(self.regions - 1)) % self.regions
        return ids


def check_scene(data: bytes) -> None:
    header, _, layers = unpack(data)
    scene = decode(data).scene
    field, regions = scene.field, scene.regions
    index = None if regions is None else regions.index_of(regions.labels).numpy()
    file, gaussians = File(header, index, header.regions), []
    for (energy, _), layer in zip(header.layers, layers, strict=True):
        gaussians += file.layer(Bits(layer), energy)
    expected = torch.cat([field.means, field.cholesky, field.colors], -1).detach().numpy()
    assert np.array_equal(np.array([numbers for numbers, _ in gaussians]).astype(np.float32), expected)
    if regions is not None:
        assert field.region_ids is not None
        assert [id for _, id in gaussians] == regions.index_of(field.region_ids).tolist()


class TestLayers:
    def test_golden(self) -> None:
        check_scene((Path(__file__).parent / "golden.kcgs").read_bytes())

    @pytest.mark.parametrize(("regions", "channels", "quality"), [(1, 1, 20.0), (3, 3, 50.0), (2, 4, 80.0)])
    def test_encoded(self, regions: int, channels: int, quality: float) -> None:
        check_scene(encode(make_scene(120, regions=regions, channels=channels, seed=3), quality=quality))


@pytest.mark.parametrize("size", [(66, 125), (1, 300), (2, 3)])
def test_cells(size: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    """Cells of three classes of size, some outside; bands of fewer cells, so that a small grid has more than eight."""
    monkeypatch.setattr(occupancy, "_GROUP", 1024)
    monkeypatch.setattr(f"{__name__}.BAND", 1024)
    generator, writer, coder, classes = np.random.default_rng(0), Writer(), occupancy.OccupancyCoder(size), []
    for s, share in ((2, 1.0), (1, 0.4), (2, 0.01)):
        count = max(int(share * min(600, size[0] * size[1])), 1)
        grid = occupancy.Grid.for_count(size, count)
        column, row = ((generator.random(count) ** 2 * (n + 1)).astype(int) for n in (grid.columns, grid.rows))
        order = np.lexsort((column, row))
        coder.code(writer, s, np.stack([column, row], -1)[order])
        classes.append((s, list(zip(row[order], column[order], strict=True))))
    bits, cells = Bits(writer.finish()), Occupancy(size)
    for s, expected in classes:
        assert cells.read(bits, s, len(expected)) == expected
