"""The range coder and its symbols, written from docs/format.md, for the decoders beside it."""

from __future__ import annotations

import bisect
import math

SIXTY_FOUR = 2**64 - 1


class Bits:
    """Section "The range coder"."""

    def __init__(self, data: bytes) -> None:
        self.data, self.low, self.range = data, 0, SIXTY_FOUR
        self.point = self.word() << 32 | self.word()

    def word(self) -> int:
        word, self.data = self.data[:4].ljust(4, b"\0"), self.data[4:]
        return int.from_bytes(word, "big")

    def code(self) -> int:
        return ((self.point - self.low) & SIXTY_FOUR) // (self.range >> 24)

    def narrow(self, a: int, b: int) -> None:
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
        self.narrow(value * width, 2**24 if value == n - 1 else (value + 1) * width)
        return value

    def categorical(self, weights: list[float]) -> int:
        sums = [0.0]
        for weight in weights:
            sums.append(sums[-1] + weight)
        scale = (2**24 - len(weights)) / sums[-1]
        begins = [*(math.floor(total * scale) + s for s, total in enumerate(sums[:-1])), 2**24]
        value = bisect.bisect(begins, self.code()) - 1
        self.narrow(begins[value], begins[value + 1])
        return value

    def bit(self, chance: int) -> int:
        border = 2**24 - 256 * chance
        value = int(self.code() >= border)
        self.narrow(*((border, 2**24) if value else (0, border)))
        return value

    def number(self, n: int) -> int:
        if n <= 65536:
            return self.uniform(n)
        high = self.number(-(-n // 65536))
        return high << 16 | self.uniform(65536)

    def plain(self, bits: int) -> int:
        return sum(self.uniform(2 ** min(16, bits - shift)) << shift for shift in range(0, bits, 16))

    def unbounded_number(self) -> int:
        bits = self.uniform(64)
        return 1 << bits - 1 | self.plain(bits - 1) if bits else 0

    def adaptive_bit(self, model: AdaptiveBit) -> int:
        value = self.bit(model.chance())
        model.learn(value)
        return value


class AdaptiveSymbol:
    def __init__(self, *weights: float) -> None:
        self.weights = list(weights)

    def read(self, bits: Bits, count: int = 1) -> list[int]:
        symbols = [bits.categorical(self.weights) for _ in range(count)]
        for symbol in symbols:
            self.weights[symbol] += 1
        return symbols


class AdaptiveBit:
    def __init__(self) -> None:
        self.ones, self.all = 2, 4

    def chance(self) -> int:
        return min(max(65536 * self.ones // self.all, 64), 65536 - 64)

    def learn(self, bit: int) -> None:
        self.ones, self.all = self.ones + 2 * bit, self.all + 2


class Bytes:
    """Bytes and varints."""

    def __init__(self, data: bytes) -> None:
        self.data = data

    def take(self, count: int) -> bytes:
        front, self.data = self.data[:count], self.data[count:]
        return front

    def varint(self) -> int:
        byte = self.take(1)[0]
        return byte if byte < 128 else byte - 128 + 128 * self.varint()
