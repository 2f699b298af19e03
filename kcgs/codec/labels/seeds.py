"""Where contours begin: a sparse set of pixels, coded by how many lie in each half of ever smaller blocks."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from kcgs.codec.adaptive import AdaptiveBit
from kcgs.codec.errors import CodecError
from kcgs.codec.rangecoder import Coder

_SIZES = 8  # contexts, by how many are in the block


class _Block(NamedTuple):
    top: int
    bottom: int
    left: int
    right: int
    seeds: int

    @property
    def size(self) -> int:
        return (self.bottom - self.top) * (self.right - self.left)

    def halves(self) -> tuple[_Block, _Block]:
        """Cut across the longer side; the first half is the smaller, counts are as the block's."""
        if self.bottom - self.top >= self.right - self.left:
            middle = (self.top + self.bottom) // 2
            return self._replace(bottom=middle), self._replace(top=middle)
        middle = (self.left + self.right) // 2
        return self._replace(right=middle), self._replace(left=middle)

    def of(self, seeds: Any) -> Any:
        """Return the part of a map that the block covers."""
        return seeds[self.top : self.bottom, self.left : self.right]


def code_seeds(coder: Coder, seeds: Any) -> None:
    """Code which entries of `seeds`, (H, W) uint8, are 1; a reader sets them."""
    height, width = seeds.shape
    count = coder.unbounded(int(np.count_nonzero(seeds)))
    if count > height * width:
        raise CodecError(f"data must mark at most {height * width} pixels; got {count}")
    extreme = [AdaptiveBit() for _ in range(_SIZES)]
    waiting = [_Block(0, height, 0, width, count)]
    while waiting:
        block = waiting.pop()
        if block.seeds == 1:
            _code_place(coder, block.of(seeds))
        elif block.seeds == block.size:
            block.of(seeds)[:] = 1
        elif block.seeds:
            waiting.extend(_code_halves(coder, block, seeds, extreme))


def _code_halves(coder: Coder, block: _Block, seeds: Any, extreme: list[AdaptiveBit]) -> tuple[_Block, _Block]:
    """Code how many of a block's seeds are in its first half: all, none, or some number between."""
    first, second = block.halves()
    low, high = max(0, block.seeds - second.size), min(block.seeds, first.size)
    count = 0 if coder.reads else int(np.count_nonzero(first.of(seeds)))
    if low < high:
        model = extreme[min(block.seeds.bit_length() - 2, _SIZES - 1)]
        if high - low < 2 or model.code(coder, count in (low, high)):
            count = high if coder.fair(count == high) else low
        else:
            count = low + 1 + coder.number(count - low - 1, high - low - 1)
    else:
        count = low
    if not low <= count <= high:
        raise CodecError("data must mark pixels of the map")
    return first._replace(seeds=count), second._replace(seeds=block.seeds - count)


def _code_place(coder: Coder, block: Any) -> None:
    place = coder.number(0 if coder.reads else int(block.argmax()), block.size)
    if place >= block.size:
        raise CodecError("data must mark pixels of the map")
    block[place // block.shape[1], place % block.shape[1]] = 1
