"""The seeds of a map, coded as their numbers in the halves of ever smaller blocks (docs/format.md, "Seeds")."""

from __future__ import annotations

from typing import Any

import numpy as np

from kcgs.codec.adaptive import AdaptiveBit
from kcgs.codec.rangecoder import CodecError, Coder

_CONTEXTS = 8  # by log2 of the number of seeds in a block


def code_seeds(coder: Coder, seeds: Any) -> None:
    """Code which entries of `seeds`, (H, W) uint8, are 1; a reader sets them."""
    count = coder.unbounded_number(int(np.count_nonzero(seeds)))
    if count > seeds.size:
        raise CodecError(f"data must mark at most {seeds.size} pixels; got {count}")
    is_extreme = [AdaptiveBit() for _ in range(_CONTEXTS)]
    stack = [(seeds, count)]
    while stack:
        block, count = stack.pop()
        if count == 1:
            index = coder.number(0 if coder.is_reader else int(block.argmax()), block.size)
            if index >= block.size:
                raise CodecError(f"data must mark one of the {block.size} pixels of a block; got number {index}")
            block[index // block.shape[1], index % block.shape[1]] = 1
        elif count == block.size:
            block[:] = 1
        elif count:
            first, second = _halves(block)
            context = min(count.bit_length() - 2, _CONTEXTS - 1)
            first_count = _code_count(coder, first, second.size, count, is_extreme[context])
            stack += [(first, first_count), (second, count - first_count)]


def _halves(block: Any) -> tuple[Any, Any]:
    """Cut across the longer side; the first half is the smaller."""
    height, width = block.shape
    if height >= width:
        return block[: height // 2], block[height // 2 :]
    return block[:, : width // 2], block[:, width // 2 :]


def _code_count(coder: Coder, first: Any, second_size: int, count: int, is_extreme: AdaptiveBit) -> int:
    """Code the number of a block's seeds in its first half: the least possible, the largest, or one between."""
    low, high = max(0, count - second_size), min(count, first.size)
    if low == high:
        return low
    first_count = 0 if coder.is_reader else int(np.count_nonzero(first))
    if high - low < 2 or is_extreme.code(coder, first_count in (low, high)):
        return high if coder.fair_bit(first_count == high) else low
    first_count = low + 1 + coder.number(first_count - low - 1, high - low - 1)
    if first_count >= high:
        raise CodecError(f"a half of a block must hold fewer than {high} seeds; got {first_count}")
    return first_count
