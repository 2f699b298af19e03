"""Which pixels of a map are seeds, by how many lie in each half of ever smaller blocks (docs/format.md, "Seeds")."""

from __future__ import annotations

from typing import Any

import numpy as np

from kcgs.codec.adaptive import AdaptiveBit
from kcgs.codec.rangecoder import CodecError, Coder

_SIZES = 8  # contexts, by how many are in the block


def code_seeds(coder: Coder, seeds: Any) -> None:
    """Code which entries of `seeds`, (H, W) uint8, are 1, by how many lie in each half of ever smaller blocks.

    A reader sets them.
    """
    count = coder.unbounded(int(np.count_nonzero(seeds)))
    if count > seeds.size:
        raise CodecError(f"data must mark at most {seeds.size} pixels; got {count}")
    extreme = [AdaptiveBit() for _ in range(_SIZES)]
    waiting = [(seeds, count)]
    while waiting:
        block, count = waiting.pop()
        if count == 1:
            place = coder.number(0 if coder.reads else int(block.argmax()), block.size)
            if place >= block.size:
                raise CodecError("data must mark pixels of the map")
            block[place // block.shape[1], place % block.shape[1]] = 1
        elif count == block.size:
            block[:] = 1
        elif count:
            first, second = _halves(block)
            inside = _code_count(coder, first, count, second.size, extreme[min(count.bit_length() - 2, _SIZES - 1)])
            waiting += [(first, inside), (second, count - inside)]


def _halves(block: Any) -> tuple[Any, Any]:
    """Cut across the longer side; the first half is the smaller."""
    height, width = block.shape
    if height >= width:
        return block[: height // 2], block[height // 2 :]
    return block[:, : width // 2], block[:, width // 2 :]


def _code_count(coder: Coder, half: Any, seeds: int, rest: int, extreme: AdaptiveBit) -> int:
    """Code how many of a block's seeds are in its first half: all, none, or some number between."""
    low, high = max(0, seeds - rest), min(seeds, half.size)
    if low == high:
        return low
    count = 0 if coder.reads else int(np.count_nonzero(half))
    if high - low < 2 or extreme.code(coder, count in (low, high)):
        return high if coder.fair(count == high) else low
    count = low + 1 + coder.number(count - low - 1, high - low - 1)
    if count >= high:
        raise CodecError("data must mark pixels of the map")
    return count
