"""Frames become records: a key frame, then what is carried on."""

from __future__ import annotations

import copy
import math
import time
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kcgs.codec import decode
from kcgs.codec.clips.carried import ClipPart
from kcgs.codec.clips.file import KEY, Record
from kcgs.codec.clips.frames import begin_part, carried_record, key_record, read_carried, read_qp
from kcgs.codec.clips.motion import quantize_motion
from kcgs.codec.exact import Integers
from kcgs.codec.file import unpack
from kcgs.codec.gaussians.quantize import QPS
from kcgs.fitting import FitConfig, fit
from kcgs.functional import psnr
from kcgs.kernels import threads_for_kernels
from kcgs.rate.budget import count_for
from kcgs.rate.compress import compress, quality_for

from .budget import SLOPE, Budget
from .carrying import Carrying
from .registration import register
from .report import FrameReport

# steps of the quantization parameter by which a carried frame is coarser than its key frame, without a budget
_COARSER = 64
# dB below a new key frame that a carried frame may lose at most, and for each halving of its bytes: files lose as much;
# what is above so many dB is good
_LOST, _HALVED, _GOOD = 4.0, 1.9, 40.0
# what a key frame cannot show is what a blur takes away: its width in radii of each Gaussian's share of the image, at
# least in pixels; dB of the error for each dB of that
_BLUR, _LEAST_BLUR, _FOLLOWS = 0.4, 0.5, 1.25
# share of the last key frame's bytes that a budget must have for another one
_AFFORDED = 0.6
# how often a frame is made coarser for a budget; the last time only its motions are left
_TRIES = 5
# of the slope that is usual, the least that two tries may show
_LEAST_SLOPE = 0.25


class VideoEncoder:
    """Fits frames one after another."""

    def __init__(
        self, config: FitConfig, num_gaussians: int | None, seed: int, key_interval: int, budget: Budget | None = None
    ) -> None:
        self._config = config.model_copy(update={"refine_flat": False})
        self._wanted, self._seed, self._interval, self._budget = num_gaussians, seed, key_interval, budget
        self._most, self._coarser = num_gaussians or 1, _COARSER
        self._part: ClipPart | None = None
        self._last: Tensor | None = None  # the frame before, as it was given
        self._qp, self._key_bytes, self._since, self._keys = 0, 0, 0, 0  # key frames since the last carried one
        self._key_psnr = self._key_detail = 0.0
        self._positions: dict[int, int] = {}  # of given ids among those of the part
        self._number = 0

    def add(self, image: Tensor, labels: Tensor | None) -> tuple[Record, FrameReport]:
        """Fit the next frame, (C, H, W), with its map, or None: it is carried on."""
        start = time.process_time()
        with threads_for_kernels(image[0].numel()):
            found = self._carry(image, labels)
            record, value, born = self._begin(image, labels) if found is None else found
        assert self._part is not None
        number, count = self._number, len(self._part.frame.region)
        self._go_on(image, record)
        seconds = time.process_time() - start
        return record, FrameReport(number, found is None, value, len(record.data), count, born, seconds)

    def skip(self, image: Tensor, labels: Tensor | None, record: Record) -> Record:
        """Take a frame that was fitted before."""
        with threads_for_kernels(image[0].numel()):
            if record.kind == KEY:
                self._start(record.data, image, self._carried_map(image, labels))
            else:
                assert self._part is not None
                read_carried(self._part, record)
        self._go_on(image, record)
        return record

    def _go_on(self, image: Tensor, record: Record) -> None:
        self._keys = self._keys + 1 if record.kind == KEY else 0
        if self._budget is not None:
            self._budget.spend(record)
            if record.kind != KEY:
                self._coarser = self._qp - read_qp(record)[0] - self._budget.step(len(record.data))
        self._last, self._number, self._since = image, self._number + 1, self._since + 1

    def _begin(self, image: Tensor, labels: Tensor | None) -> tuple[Record, float, int]:
        """Fit a key frame."""
        labels = self._carried_map(image, labels)
        goal: dict[str, Any] = {} if self._budget is None else {"target_bytes": self._key_share()}
        count = self._count(goal.get("target_bytes", 0), image)
        result = fit(image, labels, count, recipe=self._config, seed=self._seed)
        if not goal:
            goal["quality"] = quality_for(max(entry.psnr for entry in result.history))
        data = compress(result.scene, image, seed=self._seed, objective=self._config.objective, **goal).data
        self._start(data, image, labels)
        assert self._part is not None
        return key_record(data), self._key_psnr, len(self._part.frame.region)

    def _key_share(self) -> int:
        """Return the bytes of a key frame that begins here.

        Where carrying failed twice, each time at once, it will again: all are key frames, and have even shares.
        """
        assert self._budget is not None
        return self._budget.for_frame() if self._fails_at_once() else self._budget.for_key()

    def _fails_at_once(self) -> bool:
        return self._keys >= 2 and self._interval > 1

    def _count(self, num_bytes: int, image: Tensor) -> int:
        """Return how many Gaussians a part has at most; with a budget its key frame has so many bytes."""
        return self._wanted or count_for(num_bytes, image[0].numel(), self._config.objective)

    def _carried_map(self, image: Tensor, labels: Tensor | None) -> Tensor | None:
        """Return the map of a key frame: where none is given, the last one as its regions move."""
        part, last = self._part, self._last
        if labels is not None or part is None or last is None or part.frame.index is None:
            return labels
        regions = part.regions(part.moved(self._motions(part, last, image))[1])
        return None if regions is None else regions.labels

    def _start(self, data: bytes, image: Tensor, labels: Tensor | None) -> None:
        """Begin a part with a still file."""
        scene = decode(data).scene
        self._part = begin_part(scene, self._part)
        self._qp, self._key_bytes, self._since = unpack(data)[0].qp, len(data), 0
        self._most = self._count(len(data), image)
        self._key_psnr, self._key_detail = float(psnr(scene.render(), image)), _detail(image, self._most)
        self._positions = {}
        index = self._part.frame.index
        for region in [] if labels is None else torch.unique(labels).tolist():  # the fit may have merged some, or all
            inside = None if index is None else torch.from_numpy(index)[labels == region]
            self._positions[region] = 0 if inside is None else int(torch.mode(inside).values)

    def _carry(self, image: Tensor, labels: Tensor | None) -> tuple[Record, float, int] | None:
        """Carry the last frame on; None where a key frame is better."""
        part, last = self._part, self._last
        if part is None or last is None or self._since >= self._interval:
            return None
        given = self._given(labels)
        if labels is not None and given is None:
            return None  # a region that the key frame does not know
        numbers = self._motions(part, last, image)
        found = self._write(part, numbers, image, given)
        if found is None:
            return None
        record, born, part = found
        value = float(psnr(part.scene().render(), image))
        lost = min(max(_HALVED * math.log2(self._key_bytes / len(record.data)), 0.0), _LOST)
        if value < self._expected(image) - lost and self._affords_key():
            return None
        self._part = part
        return record, value, born

    def _expected(self, image: Tensor) -> float:
        """Return the PSNR that a new key frame would about have, or what is good enough."""
        harder = _detail(image, self._most) - self._key_detail
        return min(self._key_psnr - _FOLLOWS * harder, _GOOD)

    def _affords_key(self) -> bool:
        if self._budget is None or self._fails_at_once():
            return True
        return self._budget.for_key() >= _AFFORDED * self._key_bytes

    def _write(
        self, part: ClipPart, numbers: Integers, image: Tensor, given: Any
    ) -> tuple[Record, int, ClipPart] | None:
        """Write a carried frame, as the budget allows; return how many Gaussians are new, and the part, gone on.

        None: no Gaussian is left.
        """
        most = math.inf if self._budget is None else self._budget.most()
        coarser, tried = self._coarser, list[tuple[int, float]]()  # quantization parameters, and logarithms of bytes
        for attempt in range(_TRIES):
            ahead = copy.deepcopy(part)
            qp = min(max(self._qp - coarser, QPS[0]), QPS[1])
            stands = attempt == _TRIES - 1  # as predicted, its map too
            carrying = Carrying(part, numbers, image, None if stands else given, self._config, qp)
            change = carrying.stand() if stands else carrying.fit(self._most, self._seed + self._number)
            if not len(change.codes) + len(change.born_region):
                return None
            record = carried_record(ahead, qp, numbers, change)
            if len(record.data) <= most:
                return record, len(change.born_region), ahead
            tried.append((qp, math.log(len(record.data))))
            coarser += 4 + round((tried[-1][1] - math.log(max(most, 1))) / _slope(tried))
        raise ValueError(f"target_bytes or kbps must leave {len(record.data)} bytes; they leave {most}")

    def _given(self, labels: Tensor | None) -> Any:
        """Return a given map as positions of the part's regions; None where there is none, or they do not know it."""
        if labels is None or not self._positions:
            return None
        ids, inverse = torch.unique(labels, return_inverse=True)
        positions = [self._positions.get(region, -1) for region in ids.tolist()]
        if min(positions) < 0:
            return None
        return torch.tensor(positions, dtype=torch.int32)[inverse].numpy()

    @staticmethod
    def _motions(part: ClipPart, last: Tensor, image: Tensor) -> Integers:
        """Find the motion of each region, as numbers of a file."""
        index, size = part.frame.index, part.size
        numbers = part.motions.last.copy()
        present = [0] if index is None else np.unique(index).tolist()
        for region in present:
            mask = torch.ones(size, dtype=torch.bool) if index is None else torch.from_numpy(index == region)
            motion = torch.eye(3, dtype=torch.float64)
            motion[:2] = register(last, image, mask)
            if abs(float(torch.linalg.det(motion[:2, :2])) - 1.0) > 0.5:
                motion = torch.eye(3, dtype=torch.float64)
            numbers[region] = quantize_motion(torch.linalg.inv(motion)[:2].numpy(), size)
        return numbers


def _detail(image: Tensor, count: int) -> float:
    """Return how much of an image so many Gaussians leave out, in dB, by what a blur takes away."""
    from kornia.filters import gaussian_blur2d

    sigma = max(_BLUR * math.sqrt(image[0].numel() / (math.pi * count)), _LEAST_BLUR)
    side = 2 * math.ceil(3 * sigma) + 1
    blurred = gaussian_blur2d(image[None], (side, side), (sigma, sigma), border_type="replicate")[0]
    return 10 * math.log10(max(float((image - blurred).square().mean()), 10 ** (-_GOOD / 10)))


def _slope(tried: list[tuple[int, float]]) -> float:
    """Return how the logarithm of a frame's bytes rises with its quantization parameter, by the last two tries."""
    if len(tried) < 2 or tried[-2][0] == tried[-1][0]:
        return SLOPE
    (finer, more), (coarser, less) = tried[-2:]
    return min(max((more - less) / (finer - coarser), _LEAST_SLOPE * SLOPE), SLOPE)
