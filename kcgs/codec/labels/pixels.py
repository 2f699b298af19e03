"""The pixels of a label map, wavefront by wavefront (docs/format.md, "Pixels"); importing this loads numba."""

from __future__ import annotations

from typing import Any

import numpy as np

from kcgs.codec.adaptive import AdaptiveBit
from kcgs.codec.rangecoder import CodecError, Coder

from .contexts import LEFT, TOP
from .seeds import code_seeds
from .wavefront import MAX_NEAREST, Scan, advance, find_nearest, new_scan

# limits that keep the work of a decoder to seconds
MAX_CODED = 1 << 23  # pixels decided by bits
MAX_EXPLICIT = 1 << 18  # explicit labels


class WorkLimitError(CodecError):
    """A map that would take minutes to decode."""


def code_pixels(coder: Coder, truth: Any, seeds: Any, num_regions: int, *, is_file: bool) -> Any:
    """Code a map of numbered regions; return it, (H, W) int32.

    Args:
        coder: of the stream.
        truth: number of each pixel's region, (H, W) int32; empty for a decoder.
        seeds: (H, W) uint8, 1 where a pixel is a seed; a decoder fills them in.
        num_regions: at least 2.
        is_file: whether this is the file of a label map, not of a scene.
    """
    code_seeds(coder, seeds)
    height, width = seeds.shape
    scan = new_scan(seeds, num_regions, is_file=is_file)
    explicit_labels = _ExplicitLabels(coder, scan, num_regions)
    bits, total = scan.answers[:0], 0
    while num_pixels := advance(scan, bits, truth):
        num_coded = int(scan.state["num_coded"])
        total += num_coded
        if total > MAX_CODED:
            raise WorkLimitError(f"data must code at most {MAX_CODED} pixels near contours; got more")
        num_bits = num_coded if num_regions == 2 else 2 * num_coded
        if num_bits:
            bits = coder.bits(scan.chances[:num_bits], scan.answers[:num_bits])
        if num_regions > 2 and (num_pixels > num_coded or np.count_nonzero(bits[:num_coded])):
            explicit_labels.code(scan.pixels[:num_pixels], bits[:num_coded] != 0)
    return scan.labels[TOP : TOP + height, LEFT : LEFT + width]


class _ExplicitLabels:
    """Code labels of seeds, and of pixels that have neither candidate, in maps of three regions or more."""

    def __init__(self, coder: Coder, scan: Scan, num_regions: int) -> None:
        self._coder, self._labels, self._num_regions = coder, scan.labels, num_regions
        self._num_met = 1  # regions that already have a pixel
        self._count = 0
        # models of seeds, and of coded pixels
        self._is_new = [AdaptiveBit(), AdaptiveBit()]
        self._is_nearest = [[AdaptiveBit() for _ in range(MAX_NEAREST)] for _ in range(2)]

    def code(self, pixels: Any, is_neither: Any) -> None:
        """Code a wavefront's explicit labels; `is_neither` marks the coded pixels with neither candidate."""
        is_explicit = pixels["is_coded"] == 0
        is_explicit[~is_explicit] = is_neither
        self._count += int(is_explicit.sum())
        if self._count > MAX_EXPLICIT:
            raise WorkLimitError(f"data must hold at most {MAX_EXPLICIT} labels that no neighbour has; got more")
        for index in np.flatnonzero(is_explicit):
            pixels[index]["label"] = self._code_label(pixels[index])

    def _code_label(self, pixel: Any) -> int:
        label, is_coded = int(pixel["label"]), int(pixel["is_coded"])
        if self._num_met < self._num_regions and self._is_new[is_coded].code(self._coder, label == self._num_met):
            self._num_met += 1
            return self._num_met - 1
        nearest = np.zeros(MAX_NEAREST, np.int32)
        for rank in range(find_nearest(self._labels, pixel, nearest)):
            candidate = int(nearest[rank])
            if self._is_nearest[is_coded][rank].code(self._coder, label == candidate):
                return candidate
        if (label := self._coder.number(label, self._num_met)) >= self._num_met:
            raise CodecError(f"data must hold labels of the {self._num_met} regions met so far; got {label}")
        return label
