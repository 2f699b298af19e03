"""Label maps of a clip, each coded by where it deviates from a predicted one (docs/format.md)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kcgs._check import check_count
from kcgs.codec.adaptive import AdaptiveBit
from kcgs.codec.file import MOST_LABELS, MOST_REGIONS
from kcgs.codec.rangecoder import CodecError, Coder

from .deviation import (
    ASKED,
    DECIDED,
    FRONT,
    MARGIN,
    REGIONS,
    ROW,
    STATE,
    USED,
    advance,
    ask_others,
    find_seeds,
    load_network,
    mark_band,
    new_counters,
    program,
)
from .seeds import code_seeds

# what a reader may be asked to work through: seconds
_MOST_ASKED, _MOST_LISTED = 1 << 23, 1 << 18
_NOISY = np.array([2.0**-10])  # chance of a map that is better not predicted


class FollowingLabels:
    """Code label maps that follow each other, by a prediction of each; one object learns from map to map.

    A writer and a reader start with an object each, and call it with the same predicted maps.

    Args:
        num_regions: regions that the maps may hold, 2 to 2**24 - 1; a map need not hold all.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> from kcgs.codec.rangecoder import Reader, Writer
        >>> last = np.repeat(np.array([[0, 1]], np.int32), 20, axis=1) + np.zeros((30, 1), np.int32)
        >>> index = last.copy()
        >>> index[10:20, 20:22] = 0
        >>> writer = Writer()
        >>> FollowingLabels(2).code(writer, last, index).dtype
        dtype('int32')
        >>> data = writer.finish()
        >>> bool((FollowingLabels(2).code(Reader(data), last) == index).all())
        True
    """

    def __init__(self, num_regions: int) -> None:
        check_count("num_regions", num_regions, 2, MOST_REGIONS)
        self._regions = num_regions
        self._same = AdaptiveBit()
        self._memory = new_counters()
        self._network = load_network()

    def code(self, coder: Coder, predicted: Any, index: Any = None) -> Any:
        """Code a map of positions, 0 to R - 1: write `index`, or read one where the coder is a reader.

        Args:
            coder: a Writer or a Reader.
            predicted: :math:`(H, W)` int32, what `move_labels` makes of the last map; the same for both.
            index: :math:`(H, W)` int32, the map to write; None for a reader.

        Returns:
            :math:`(H, W)` int32, the map.

        Raises:
            ValueError: a map has another type or size, or holds other positions.
            CodecError: the stream is damaged.
        """
        predicted = self._check("predicted", predicted)
        if not coder.reads:
            index = self._check("index", index)
            if index.shape != predicted.shape:
                raise ValueError(f"index must have the size {predicted.shape} of predicted; got {index.shape}")
        program.ready()
        if self._same.code(coder, not coder.reads and np.array_equal(index, predicted)):
            return predicted.copy()
        if coder.reads:
            return self._read(coder, predicted)
        return self._write(coder, predicted, index)

    def _check(self, name: str, labels: Any) -> Any:
        labels = np.asarray(labels)
        if labels.ndim != 2 or labels.dtype != np.int32 or not 1 <= labels.size <= MOST_LABELS:
            raise ValueError(f"{name} must be (H, W) int32, of 1 to {MOST_LABELS}; got {labels.shape} {labels.dtype}")
        low, high = int(labels.min()), int(labels.max())
        if low < 0 or high >= self._regions:
            raise ValueError(f"{name} must hold positions 0 to {self._regions - 1}; got {low} to {high}")
        return np.ascontiguousarray(labels)

    def _write(self, coder: Coder, predicted: Any, index: Any) -> Any:
        run, kept = _Run(self._regions, predicted, index), tuple(table.copy() for table in self._memory)
        asked = find_seeds(index, predicted, run.asked.copy(), run.seeds)
        chances, bits, cost = [], [], math.inf

        def take(chance: Any, answers: Any) -> Any:
            chances.append(chance.copy())
            bits.append(answers.copy())
            return bits[-1]

        if asked <= _MOST_ASKED:
            run.code(take, self._memory, self._network)
            chance, bit = (np.concatenate(parts) if parts else np.zeros(0) for parts in (chances, bits))
            cost = -np.log2(np.where(bit, chance, 1 - chance)).sum()
            cost += 16 * np.count_nonzero(run.seeds) + int(run.state[USED]) * math.log2(self._regions)
        noisy = cost > index.size * math.log2(self._regions) + 64 or run.state[USED] > _MOST_LISTED
        coder.bits(_NOISY, np.array([noisy], np.int32))
        if noisy:
            self._memory = kept
            coder.numbers(index.reshape(-1), self._regions, index.size)
            return index.copy()
        code_seeds(coder, run.seeds)
        if self._regions > 2:
            coder.numbers(run.listed[: coder.unbounded(int(run.state[USED]))], self._regions, int(run.state[USED]))
        if len(bit):
            coder.bits(chance, bit.astype(np.int32))
        return run.result()

    def _read(self, coder: Coder, predicted: Any) -> Any:
        if coder.bits(_NOISY, np.zeros(1, np.int32))[0]:
            return coder.numbers(None, self._regions, predicted.size).reshape(predicted.shape)
        run = _Run(self._regions, predicted)
        code_seeds(coder, run.seeds)
        if self._regions > 2:
            if (count := coder.unbounded(0)) > _MOST_LISTED:
                raise CodecError(f"data must list at most {_MOST_LISTED} labels; got {count}")
            run.listed = coder.numbers(None, self._regions, count)
        run.code(coder.bits, self._memory, self._network)
        if run.state[USED] != len(run.listed):
            raise CodecError(f"data must list {run.state[USED]} labels; got {len(run.listed)}")
        return run.result()


class _Run:
    """What coding one map works on."""

    def __init__(self, regions: int, predicted: Any, truth: Any = None) -> None:
        size = predicted.shape
        self.state, self.asked, self.seeds = (
            np.zeros(STATE, np.int64),
            np.zeros(size, np.uint8),
            np.zeros(size, np.uint8),
        )
        self.state[[REGIONS, FRONT]] = regions, -1
        self.truth = np.zeros((0, 0), np.int32) if truth is None else truth
        self.listed = np.zeros(0 if truth is None or regions == 2 else np.count_nonzero(truth != predicted), np.int32)
        self._predicted = np.pad(predicted, MARGIN, mode="edge")
        self._labels = self._predicted.copy()
        mark_band(predicted, self.asked)

    def code(self, code: Any, memory: Any, network: Any) -> None:
        """Code the bits of all wavefronts by `code(chances, answers)`, which returns them."""
        height = len(self.seeds)
        rows, chances, answers = np.zeros((height, ROW), np.int32), np.zeros(height), np.zeros(height, np.int32)
        state, maps = self.state, (self._labels, self._predicted, self.seeds, self.asked)
        bits = others = none = answers[:0]
        while advance(bits, others, state, self.truth, self.listed, *maps, rows, *memory, network, chances, answers):
            if state[ASKED] > _MOST_ASKED:
                raise CodecError(f"data must ask for at most {_MOST_ASKED} pixels; got more")
            count = int(state[DECIDED])
            bits, others = code(chances[:count], answers[:count]) if count else none, none
            if state[REGIONS] > 2 and bits.any():
                count = ask_others(bits, state, rows, *memory, chances, answers)
                others = code(chances[:count], answers[:count]) if count else none

    def result(self) -> Any:
        """Return the map."""
        return self._labels[MARGIN:-MARGIN, MARGIN:-MARGIN].copy()
