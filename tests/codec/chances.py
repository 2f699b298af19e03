"""The chances of a pixel, written from docs/format.md, for the decoder of maps."""

from __future__ import annotations

import bisect
import math
from operator import mul
from pathlib import Path
from typing import Any

import numpy as np

import kcgs.codec

SPANS = [(-8, -1), (-8, 7), (-7, 8), (-6, 7), (-5, 6), (-3, 4), (-2, 3)]
TEMPLATE = sorted(
    ((dx, -row) for row, (first, last) in enumerate(SPANS) for dx in range(first, last + 1)),
    key=lambda place: (place[0] ** 2 + place[1] ** 2, -place[1], place[0]),
)


def clip(value: int, most: int) -> int:
    return min(max(value, -most), most)


SQUASH = {x: math.floor(65536 / (1 + math.exp(-x / 256)) + 0.5) for x in range(-3071, 3072)}
RISE = list(SQUASH.values())
STRETCH = [bisect.bisect_left(RISE, 16 * q + 8) - 3071 for q in range(4096)]


class Prior:
    """The tables of the label model, whose layers have `a` and `b` units."""

    def __init__(self, name: str, a: int, b: int) -> None:
        data = (Path(kcgs.codec.__file__).parent / "labels" / name).read_bytes()

        def take(kind: str, *shape: int) -> Any:
            nonlocal data
            size = math.prod(shape) * np.dtype(kind).itemsize
            array, data = np.frombuffer(data[:size], kind).reshape(shape), data[size:]
            return array.tolist()

        self.layer1 = take("<i1", len(TEMPLATE), 2, a)
        self.bias1 = take("<i2", a)
        self.layer2 = list(zip(*take("<i1", a, b), strict=True))
        self.bias2 = take("<i4", b)
        self.layer3 = list(zip(*take("<i1", b, 2), strict=True))
        self.bias3 = take("<i4", 2)
        self.mixer = take("<i4", 4)
        assert not data

    def logits(self, features: list[int]) -> list[int]:
        rows = [self.layer1[t][f - 1] for t, f in enumerate(features) if f]
        a = [min(max(total, 0), 4095) for total in map(sum, zip(self.bias1, *rows, strict=True))]
        b = [
            min(max((bias + sum(map(mul, a, column))) >> 6, 0), 4095)
            for bias, column in zip(self.bias2, self.layer2, strict=True)
        ]
        return [
            clip((bias + sum(map(mul, b, column))) >> 4, 3071)
            for bias, column in zip(self.bias3, self.layer3, strict=True)
        ]


OF_SCENES, OF_MAPS = Prior("scene_prior.bin", 48, 16), Prior("map_file_prior.bin", 96, 32)


class Model:
    """The adaptive part of one of the two decisions."""

    def __init__(self, prior: Prior) -> None:
        self.prior, self.weights = prior, [list(prior.mixer) for _ in range(4)]
        self.counters: list[dict[tuple[int, ...], list[int]]] = [{}, {}, {}]


class Decision:
    """A decision about one pixel."""

    def __init__(self, model: Model, logit: int, keys: list[tuple[int, ...]]) -> None:
        tables = zip(model.counters, keys, strict=True)
        self.counters = [table.setdefault(key, [0, 0]) for table, key in tables]
        self.x = [logit, *(STRETCH[chance >> 4] if age else logit for chance, age in self.counters)]
        self.weights = model.weights[bisect.bisect([1, 5, 12], self.counters[2][1])]
        self.p = min(max(SQUASH[clip(sum(map(mul, self.weights, self.x)) >> 16, 3071)], 16), 65520)

    def learn(self, bit: int) -> None:
        e = 65536 * bit - self.p
        self.weights[:] = [
            clip(w + ((6 * x * e + 2**17) >> 18), 2**22) for w, x in zip(self.weights, self.x, strict=True)
        ]
        for counter in self.counters:
            chance, age = counter if counter[1] else (SQUASH[self.x[0]], 2)
            chance += 2 * (65536 * bit - chance) // (2 * age + 3)
            counter[:] = min(max(chance, 32), 65504), min(age + 1, 40)


class Pixel:
    """A pixel that is not quiet: its candidates and decisions."""

    def __init__(self, neighbours: list[int], models: list[Model]) -> None:
        first = neighbours[0]
        second = next(label for label in neighbours if label != first)
        self.candidates = [first, second]
        f = [0 if label == first else 1 if label == second else 2 for label in neighbours]
        logits = models[0].prior.logits(f)
        keys = [tuple(value > 0 for value in f[1 : 1 + nearest]) for nearest in (6, 11, 16)]
        self.is_second = Decision(models[0], logits[0], keys)
        self.is_neither = Decision(models[1], logits[1], [(), tuple(f[1:5]), tuple(f[1:9])])
