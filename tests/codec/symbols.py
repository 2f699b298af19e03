"""What files are made of, as docs/format.md says it: a range decoder of plain numbers, for the decoders beside it."""

from __future__ import annotations

import bisect
import math

SIXTY_FOUR = 2**64 - 1


class Symbols:
    """The range coder; categorical symbols and Uniforms."""

    def __init__(self, data: bytes) -> None:
        self.data, self.low, self.range = data, 0, SIXTY_FOUR
        self.point = self.word() << 32 | self.word()

    def word(self) -> int:
        word, self.data = self.data[:4].ljust(4, b"\0"), self.data[4:]
        return int.from_bytes(word, "big")

    def code(self) -> int:
        return ((self.point - self.low) & SIXTY_FOUR) // (self.range >> 24)

    def found(self, a: int, b: int) -> None:
        step = self.range >> 24
        self.low, self.range = (self.low + a * step) & SIXTY_FOUR, (b - a) * step
        if self.range < 2**32:
            self.low, self.range = self.low << 32 & SIXTY_FOUR, self.range << 32
            self.point = self.point << 32 & SIXTY_FOUR | self.word()

    def uniform(self, n: int) -> int:
        if n == 1:
            return 0
        width = 2**24 // n
        value = min(self.code() // width, n - 1)
        self.found(value * width, 2**24 if value == n - 1 else (value + 1) * width)
        return value

    def categorical(self, weights: list[float]) -> int:
        sums = [0.0]
        for weight in weights:
            sums.append(sums[-1] + weight)
        scale = (2**24 - len(weights)) / sums[-1]
        begins = [*(math.floor(total * scale) + s for s, total in enumerate(sums[:-1])), 2**24]
        value = bisect.bisect(begins, self.code()) - 1
        self.found(begins[value], begins[value + 1])
        return value


class Choices:
    def __init__(self, *weights: float) -> None:
        self.weights = list(weights)

    def read(self, symbols: Symbols, count: int = 1) -> list[int]:
        found = [symbols.categorical(self.weights) for _ in range(count)]
        for value in found:
            self.weights[value] += 1
        return found


class Learnt:
    def __init__(self) -> None:
        self.ones, self.all = 2, 4

    def chance(self) -> int:
        return min(max(65536 * self.ones // self.all, 64), 65536 - 64)

    def learn(self, bit: int) -> None:
        self.ones, self.all = self.ones + 2 * bit, self.all + 2


class Bits(Symbols):
    """Bits, numbers, unbounded numbers, adaptive bits."""

    def bit(self, chance: int) -> int:
        border = 2**24 - 256 * chance
        value = int(self.code() >= border)
        self.found(*((border, 2**24) if value else (0, border)))
        return value

    def number(self, n: int) -> int:
        if n <= 65536:
            return self.uniform(n)
        high = self.number(-(-n // 65536))
        return high << 16 | self.uniform(65536)

    def plain(self, bits: int) -> int:
        return sum(self.uniform(2 ** min(16, bits - at)) << at for at in range(0, bits, 16))

    def magnitude(self) -> int:
        bits = self.uniform(64)
        return 1 << bits - 1 | self.plain(bits - 1) if bits else 0

    def learnt(self, model: Learnt) -> int:
        value = self.bit(model.chance())
        model.learn(value)
        return value


class Bytes:
    """The file."""

    def __init__(self, data: bytes) -> None:
        self.data = data

    def take(self, count: int) -> bytes:
        taken, self.data = self.data[:count], self.data[count:]
        return taken

    def varint(self) -> int:
        byte = self.take(1)[0]
        return byte if byte < 128 else byte - 128 + 128 * self.varint()
