"""Where contours start: a sparse set of pixels, coded by how many lie in each half of ever smaller blocks."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from .errors import CodecError
from .rangecoder import Coder, Counter, fair, magnitude, uniform

_SIZES = 8  # contexts, by how many are in the block


class _Block(NamedTuple):
    top: int
    bottom: int
    left: int
    right: int
    marks: int

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

    def of(self, marks: Any) -> Any:
        """Return the part of a map that the block covers."""
        return marks[self.top : self.bottom, self.left : self.right]


def code_starts(coder: Coder, marks: Any) -> None:
    """Code which entries of `marks`, (H, W) uint8, are 1; a reader sets them."""
    height, width = marks.shape
    count = magnitude(coder, int(np.count_nonzero(marks)))
    if count > height * width:
        raise CodecError(f"data must mark at most {height * width} pixels; got {count}")
    together = [Counter(2) for _ in range(_SIZES)]
    waiting = [_Block(0, height, 0, width, count)]
    while waiting:
        block = waiting.pop()
        if block.marks == 1:
            _code_place(coder, block.of(marks))
        elif block.marks == block.size:
            block.of(marks)[:] = 1
        elif block.marks:
            waiting.extend(_share(coder, block, marks, together))


def _share(coder: Coder, block: _Block, marks: Any, together: list[Counter]) -> tuple[_Block, _Block]:
    """Code how many of a block's marks are in its first half: all, none, or some number between."""
    first, second = block.halves()
    low, high = max(0, block.marks - second.size), min(block.marks, first.size)
    count = 0 if coder.reads else int(np.count_nonzero(first.of(marks)))
    if low < high:
        counter = together[min(block.marks.bit_length() - 2, _SIZES - 1)]
        if high - low < 2 or counter.code(coder, count in (low, high)):
            count = high if fair(coder, count == high) else low
        else:
            count = low + 1 + uniform(coder, count - low - 1, high - low - 1)
    else:
        count = low
    if not low <= count <= high:
        raise CodecError("data must mark pixels of the map")
    return first._replace(marks=count), second._replace(marks=block.marks - count)


def _code_place(coder: Coder, block: Any) -> None:
    at = uniform(coder, 0 if coder.reads else int(block.argmax()), block.size)
    if at >= block.size:
        raise CodecError("data must mark pixels of the map")
    block[at // block.shape[1], at % block.shape[1]] = 1
