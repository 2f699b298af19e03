"""The fewest Gaussians that reach a PSNR: bisection over their number, by finished fits.

Every fit but the first takes up again the one with the nearest number, with some more Gaussians or without those that
are missed least.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from kcgs.functional import RegionMap, psnr

from .config import FitConfig
from .start import draft_cutoff, start
from .state import FitResult, FitState, StopReason
from .strategies import Densify, finish
from .strategies.densify import leave_out

# the first fit has a Gaussian for so many pixels
_SPACING = 256
# PSNR in dB that twice as many Gaussians add, on photos
_SLOPE = 3.0
# the answer is known where so many times fewer Gaussians are too few, or are expected to be
_CLOSE, _EXPECTED = 1.04, 1.025
# share of a fit from which on an earlier one is taken up again
_AGAIN = 0.6


class _Probe(NamedTuple):
    num_gaussians: int
    psnr: float  # of the finished scene, clipped, in dB
    result: FitResult
    state: FitState


@dataclass
class Search:
    """The fewest Gaussians, at most `most`, with which a finished fit reaches `target_psnr`.

    `run` takes a fit from its state to its end. Where the most do not reach it, the result is theirs; where the clock
    ends the search first, that of the best fit so far.
    """

    image: Tensor
    regions: RegionMap | None
    most: int
    config: FitConfig
    seed: int
    run: Callable[[FitState], StopReason]

    def search(self) -> FitResult:
        """Return the smallest scene that was found to reach the target, else the best."""
        started, target = time.perf_counter(), self.config.target_psnr
        assert target is not None
        probes: list[_Probe] = []
        count: int | None = self.within(self.image[0].numel() // _SPACING)
        while count is not None:
            left = (self.config.max_seconds or math.inf) - (time.perf_counter() - started)
            probes.append(self.fit(count, probes, left))
            count = None if probes[-1].result.stop_reason in ("callback", "seconds") else self.next_count(probes)
        enough = [probe for probe in probes if probe.psnr >= target]
        best = min(enough, key=lambda p: p.num_gaussians) if enough else max(probes, key=lambda p: p.psnr)
        reason = probes[-1].result.stop_reason
        if enough and reason != "callback":
            reason = "target_psnr"
        seconds = time.perf_counter() - started
        return best.result._replace(stop_reason=reason, config=self.config, seconds=seconds)

    def fit(self, count: int, probes: list[_Probe], seconds: float) -> _Probe:
        """Make a fit like any other, or take up an earlier one."""
        clock = None if math.isinf(seconds) else max(seconds, 1e-3)
        changes = {"target_psnr": None, "max_seconds": clock, "iterations": self.config.usual_iterations}
        settings = self.config.model_copy(update=changes)
        near = min(probes, key=lambda p: abs(math.log(p.num_gaussians / count)), default=None)
        if near is None or settings.optimizer != "frame" or near.result.stop_reason == "diverged":
            state = start(self.image, self.regions, count, settings, self.seed, time.perf_counter())
        else:
            state = replace(
                near.state, config=settings, num_gaussians=count, started=time.perf_counter(),
                cutoff=draft_cutoff(settings), iteration=round(_AGAIN * settings.usual_iterations), first=count,
                wanted=count, late_moves=0, history=[], best=None, best_score=-math.inf,
            )  # fmt: skip
            state.optimizer = copy.deepcopy(near.state.optimizer)
            leave_out(state, state.count() - count)
            with torch.no_grad():
                Densify(state).add(state, count - state.count())
        result = finish(state, self.run(state))
        return _Probe(count, float(psnr(result.scene.render().to(self.image), self.image)), result, state)

    def within(self, count: float) -> int:
        """Return a number of Gaussians that there may be."""
        return max(1, min(self.most, round(count)))

    def next_count(self, probes: list[_Probe]) -> int | None:
        """Return how many to try next; None: the answer is known."""
        target = self.config.target_psnr
        assert target is not None
        high = min((p for p in probes if p.psnr >= target), key=lambda p: p.num_gaussians, default=None)
        fewer = (p for p in probes if p.psnr < target and (high is None or p.num_gaussians < high.num_gaussians))
        low = max(fewer, key=lambda p: p.num_gaussians, default=None)
        if high is None:
            assert low is not None
            octaves = max((target - low.psnr) / _SLOPE, math.log2(_CLOSE))
            more = max(low.num_gaussians + 1, self.within(low.num_gaussians * 2.0**octaves))
            return None if low.num_gaussians == self.most else more
        slope = _SLOPE
        if low is not None:
            slope = (high.psnr - low.psnr) / math.log2(high.num_gaussians / low.num_gaussians)
            if low.num_gaussians == high.num_gaussians - 1 or high.num_gaussians / low.num_gaussians <= _CLOSE:
                return None
        octaves = (high.psnr - target) / slope
        if high.num_gaussians == 1 or octaves < math.log2(_EXPECTED):
            return None
        expected: float = high.num_gaussians / 2.0**octaves
        if low is not None:  # on a curve that bends, the secant stays at one end
            expected = math.sqrt(expected * math.sqrt(low.num_gaussians * high.num_gaussians))
        return min(max(round(expected), 1 if low is None else low.num_gaussians + 1), high.num_gaussians - 1)
