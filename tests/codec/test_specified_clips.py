"""A decoder of clips without maps, written from the words of docs/format.md: plain numbers."""

from __future__ import annotations

import math
import zlib
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from kcgs import Clip
from kcgs.codec import decode
from kcgs.codec.file import Header
from kcgs.codec.gaussians.quantize import opponent

from .symbols import Bits, Bytes, Choices
from .test_clips import clip_of
from .test_specified_layers import File, power, read_length

LOG2_E = 1.4426950408889634


class Tables:
    def __init__(self, rows: list[list[float]], memory: float) -> None:
        self.rows, self.memory = rows, memory

    def read(self, symbols: Bits, contexts: list[int]) -> list[int]:
        found = [symbols.categorical(self.rows[context]) for context in contexts]
        for context, value in zip(contexts, found, strict=True):
            self.rows[context][value] += 1
        self.rows = [[w / 2 for w in row] if sum(row) > self.memory else row for row in self.rows]
        return found


class Part:
    def __init__(self, still: bytes) -> None:
        field = decode(still).scene.field
        self.size, self.channels = field.size, field.colors.shape[-1]
        tensors = field.means, field.cholesky, field.colors
        self.gaussians = np.concatenate([t.detach().numpy() for t in tensors], 1)
        self.activity = [3] * len(field)
        self.numbers = [0] * 6
        self.same, self.factors, self.shifts = (Choices(2, 1), *(Choices(*[2] * 7, *[0.3] * 18) for _ in range(2)))
        self.gone = Tables([[40.0, 1.0] for _ in range(4)] + [[3.0, 1.0] for _ in range(4)], 2000)
        self.births = Choices(2, *[1] * 20)
        starts = [[6.0, 1.0], [3.0, 2.0], [2.0, 3.0], [2.0, 2.0]]
        self.changed = Tables([list(row) for row in starts for _ in range(6)], 300)
        sizes = [[0.3 + 4 * power(-i / (s + 1)) for i in range(16)] for s in range(5)]
        self.sizes = Tables([list(row) for _ in range(5) for row in sizes], 600)

    def read(self, data: bytes) -> None:
        stream = Bytes(data)
        qp = stream.varint() - 512
        symbols, distortion = Bits(stream.data), power(-qp / 32)
        moved = self.move(symbols)
        height, width = self.size
        inside = [0 <= m[0] < width and 0 <= m[1] < height for m in moved]
        contexts = [(0 if i else 4) + a for i, a in zip(inside, self.activity, strict=True)]
        stays = [i for i, goes in enumerate(self.gone.read(symbols, contexts)) if not goes]
        self.differ(symbols, [moved[i] for i in stays], [self.activity[i] for i in stays], distortion)
        if count := read_length(symbols, self.births):
            layer = File(Header(self.size, self.channels, qp), None, 1)
            born = [row for row, _ in layer.layer(symbols, symbols.number(128) - 64)]
            assert len(born) == count
            self.gaussians = np.concatenate([self.gaussians, np.array(born).astype(np.float32)])
            self.activity += [3] * count

    def move(self, symbols: Bits) -> list[list[float]]:
        if self.same.read(symbols)[0]:
            for place in range(6):
                size = read_length(symbols, self.shifts if place % 3 == 2 else self.factors)
                self.numbers[place] += -size if size and symbols.number(2) else size
        f11, f12, s1, f21, f22, s2 = self.numbers
        height, width = self.size
        whole = (
            65536 + 4 * f11, 4 * f12, 4096 * s1 - (4 * f11 * width + 4 * f12 * height) // 2,
            4 * f21, 65536 + 4 * f22, 4096 * s2 - (4 * f21 * width + 4 * f22 * height) // 2,
        )  # fmt: skip
        a, b, c, d, e, f = (number / 65536 for number in whole)
        area, found = a * e - b * d, []
        for x, y, l11, l21, l22, *colors in self.gaussians.astype(np.float64).tolist():
            dx, dy = x - c, y - f
            x1, x2 = (e * l11 - b * l21) / area, -b * l22 / area
            y1, y2 = (a * l21 - d * l11) / area, a * l22 / area
            first = math.sqrt(x1 * x1 + x2 * x2)
            shape = first, (x1 * y1 + x2 * y2) / first, (x1 * y2 - x2 * y1) / first
            found.append([(e * dx - b * dy) / area, (a * dy - d * dx) / area, *shape, *colors])
        return found

    def differ(self, symbols: Bits, moved: list[list[float]], activity: list[int], distortion: float) -> None:
        energies = [self.energy(one, distortion) for one in moved]
        strengths = [min(max((math.floor(math.log2(max(e, 1))) + 1) // 2 - 2, 0), 5) for _, e in energies]
        rows: list[Any] = []
        for start in range(0, len(moved), 128):
            end = min(start + 128, len(moved))
            changed = self.changed.read(symbols, [6 * activity[i] + strengths[i] for i in range(start, end)])
            numbers = self.numbers_of(symbols, sum(changed))
            rows += [numbers.pop(0) if one else [0] * (5 + self.channels) for one in changed]
        self.activity = [0 if not s else 1 if s <= 3 else 2 for s in (sum(map(abs, row)) for row in rows)]
        found = [self.changed_one(*of, distortion) for of in zip(moved, energies, rows, strict=True)]
        self.gaussians = np.array(found).reshape(len(found), 5 + self.channels).astype(np.float32)

    def numbers_of(self, symbols: Bits, count: int) -> list[list[int]]:
        rows = [[0] * (5 + self.channels) for _ in range(count)]
        order = [(5, 0), (0, 1), (1, 1), (2, 2), (4, 2), (3, 3), *((p, 4) for p in range(6, 5 + self.channels))]
        for place, kind in order:
            contexts = [5 * kind + min(sum(map(abs, row)), 4) for row in rows]
            sizes = self.sizes.read(symbols, contexts)
            sizes = [15 + symbols.magnitude() if size == 15 else size for size in sizes]
            for row, size in zip(rows, sizes, strict=True):
                row[place] = -size if size and symbols.uniform(2) else size
        return rows

    def energy(self, one: list[float], distortion: float) -> tuple[float, float]:
        area = min(math.pi * max(one[2] * one[4], 0.1), float(self.size[0] * self.size[1]))
        strength = 0.0
        for color in one[5:]:
            strength += color * color
        return area, strength * area / distortion

    def changed_one(
        self, one: list[float], energy: tuple[float, float], row: list[int], distortion: float
    ) -> list[Any]:
        x, y, l11, l21, l22, *colors = one
        inner = max(energy[1], 8.0)
        steps = [min(math.sqrt(12 / (k * inner)), 1.0) for k in (0.5, 0.5, 0.75, 0.25, 0.75)]
        d1, d2, k1, slant, k2 = (n * step for n, step in zip(row, steps, strict=False))
        e1, e2 = power(k1 * LOG2_E), power(k2 * LOG2_E)
        told = opponent(np.array([row[5:]]) * math.sqrt(12 * distortion / energy[0]), back=True)[0].tolist()
        centre, shape = [x + l11 * d1, y + (l21 * d1 + l22 * d2)], [l11 * e1, l21 * e1 + l22 * slant, l22 * e2]
        return [*centre, *shape, *(c + q for c, q in zip(colors, told, strict=True))]


@pytest.mark.parametrize("frames", [2, 6])
def test_a_clip_is_as_the_words_say(frames: int) -> None:
    known = clip_of(frames, mapped=False)
    stream = Bytes(data := known.to_bytes())
    assert stream.take(5) == b"kcgs\x04"
    size, channels, rate = (stream.varint(), stream.varint()), stream.varint(), (stream.varint(), stream.varint())
    assert (size, channels, Fraction(*rate)) == (known.size, 3, known.frame_rate)
    head = data[: len(data) - len(stream.data)]
    assert int.from_bytes(stream.take(4), "big") == zlib.crc32(head)
    part: Part | None = None
    for number in range(frames + 1):
        before = stream.data
        kind, length = stream.varint(), stream.varint()
        content = stream.take(length)
        checked = bytes([number]) + before[: len(before) - len(stream.data)]
        assert int.from_bytes(stream.take(4), "big") == zlib.crc32(checked)
        if kind == 2:
            assert number == frames and not content and not stream.data
            break
        if kind == 0:
            part = Part(content)
        else:
            assert part is not None
            part.read(content)
        field = known[number].field
        expected = np.concatenate([t.detach().numpy() for t in (field.means, field.cholesky, field.colors)], 1)
        assert np.array_equal(part.gaussians, expected)
    assert Clip.from_bytes(data).num_bytes == len(data)
