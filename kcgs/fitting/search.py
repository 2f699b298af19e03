"""The fewest Gaussians that reach a PSNR: a search over their number, by finished fits.

Short fits say about where to look. From there on every fit is a whole one; where an earlier one had nearly as many
Gaussians it is taken up again with some more, or without those that are missed least.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from kcgs.functional import RegionMap, psnr

from .config import FitConfig
from .start import start
from .state import FitResult, FitState, HistoryEntry, StopReason
from .strategies import Densify, Finish, MergeRegions
from .strategies.densify import leave_out

OnStep = Callable[[int, HistoryEntry], bool | None]

# short fits: their number at most, their share of the iterations, of the seconds, and about what the rest adds, in dB
_SHORT_FITS, _SHORT_SHARE, _SHORT_SECONDS, _REST = 5, 0.15, 0.03, 0.8
# the first fit has a Gaussian for so many pixels
_SPACING = 256
# PSNR in dB that twice as many Gaussians add: on photos, and the least and most that are believed
_SLOPE, _LEAST_SLOPE, _MOST_SLOPE = 3.0, 1.0, 12.0
# the answer is found where so many times fewer are known, or expected, to be too few
_CLOSE, _EXPECTED = 1.04, 1.025
# an earlier fit is taken up again where the number differs by no more than this factor, from this share of a fit on:
# measured on photos, the result is within 0.05 dB of that of a whole fit, at a third of the time
_NEAR, _AGAIN = 1.12, 0.6


@dataclass(frozen=True)
class _Probe:
    count: int
    psnr: float
    """Of the finished scene, clipped, in dB."""
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
    run: Callable[[FitState, OnStep | None], StopReason]
    on_step: OnStep | None
    started: float
    iterations: int = 0
    """Of all fits so far."""

    @property
    def target(self) -> float:
        """The PSNR in dB."""
        assert self.config.target_psnr is not None
        return self.config.target_psnr

    def left(self) -> float:
        """Seconds that may still be used."""
        return (self.config.max_seconds or math.inf) - (time.perf_counter() - self.started)

    def settings(self, seconds: float, **changes: object) -> FitConfig:
        """Return those of one fit, which ends within these seconds."""
        clock = None if math.isinf(seconds) else max(seconds, 1e-3)
        given = {"target_psnr": None, "max_seconds": clock, "iterations": self.config.usual_iterations}
        return self.config.model_copy(update={**given, **changes})

    def fit(self, count: int, settings: FitConfig) -> _Probe:
        """Make a fit like any other."""
        state = start(self.image, self.regions, count, settings, self.seed, time.perf_counter())
        if settings.merge_regions:
            MergeRegions(state).before(state)
        return self.finish(count, state)

    def fit_again(self, count: int, earlier: _Probe) -> _Probe:
        """Take up a fit with some more Gaussians, or without those that are missed least."""
        settings, kept = self.settings(self.left()), earlier.state
        state = replace(
            kept, config=settings, num_gaussians=count, started=time.perf_counter(),
            cutoff=max(settings.cutoff, settings.draft_cutoff), iteration=round(_AGAIN * settings.usual_iterations),
            first=count, wanted=count, late_moves=0, moving_seconds=0.0, merged=True, history=[], best=None,
            best_score=-math.inf,
        )  # fmt: skip
        state.optimizer = copy.deepcopy(kept.optimizer)
        leave_out(state, state.count() - count)
        with torch.no_grad():
            Densify(state).add(state, count - state.count())
        return self.finish(count, state)

    def finish(self, count: int, state: FitState) -> _Probe:
        """Run a fit to its end and measure what it gives."""
        before, earlier = self.iterations - state.iteration, state.started - self.started

        def on_step(iteration: int, entry: HistoryEntry) -> bool | None:
            self.iterations = before + iteration
            entry = entry._replace(iteration=before + entry.iteration, seconds=earlier + entry.seconds)
            return None if self.on_step is None else self.on_step(self.iterations, entry)

        result = Finish().apply(state, self.run(state, on_step))
        history = [entry._replace(seconds=earlier + entry.seconds) for entry in result.history]
        result = result._replace(history=history, config=self.config)
        return _Probe(count, float(psnr(result.scene.render().to(self.image), self.image)), result, state)

    def guess(self) -> tuple[int, float, _Probe]:
        """Return about how many are needed, the slope there, and the last short fit."""
        count, slope = max(1, min(self.most, self.image[0].numel() // _SPACING)), _SLOPE
        iterations = max(1, round(_SHORT_SHARE * self.config.usual_iterations))
        known: dict[int, float] = {}
        while True:
            # what takes as long in a short fit: contours stay where they are, and merge only where there are too many
            crowded = self.regions is not None and count < self.regions.num_regions and self.config.merge_regions
            probe = self.fit(
                count,
                self.settings(
                    _SHORT_SECONDS * self.left(), iterations=iterations, merge_regions=crowded, move_contours=False,
                    refine_flat=False, prune=0.0,
                ),
            )  # fmt: skip
            known[count] = probe.psnr
            if len(known) > 1:
                slope = _slope(*sorted(known.items(), key=lambda item: abs(item[1] - self.target + _REST))[:2])
            octaves = (self.target - _REST - probe.psnr) / slope
            count = self.within(count * 2.0 ** max(-4.0, min(4.0, octaves)))
            if abs(octaves) < 0.3 or count in known or len(known) >= _SHORT_FITS or self.is_over(probe):
                return count, slope, probe

    def within(self, count: float) -> int:
        """Return a number of Gaussians that there may be."""
        return max(1, min(self.most, round(count)))

    def is_over(self, probe: _Probe) -> bool:
        """Say whether the caller or the clock wants an end."""
        return probe.result.stop_reason == "callback" or self.left() <= 0

    def search(self) -> FitResult:
        """Return the smallest scene that was found to reach the target, else the best."""
        count, slope, probe = self.guess()
        probes, seconds = [probe] if self.is_over(probe) else [], 0.0
        while not probes or not (self.is_over(probes[-1]) or self.left() < seconds):
            begun = time.perf_counter()
            near = min(probes, key=lambda p: abs(math.log(p.count / count)), default=None)
            again = near is not None and self.config.optimizer == "frame" and _ratio(near.count, count) <= _NEAR
            if again and near is not None and near.result.stop_reason != "diverged":
                probes.append(self.fit_again(count, near))
            else:
                probes.append(self.fit(count, self.settings(self.left())))
            seconds = time.perf_counter() - begun
            following = self.next_count(probes, slope)
            if following is None:
                break
            count = following
        enough = [probe for probe in probes if probe.psnr >= self.target]
        if enough:
            result = min(enough, key=lambda p: p.count).result
            reason: StopReason = "callback" if probes[-1].result.stop_reason == "callback" else "target_psnr"
        else:
            result = max(probes, key=lambda p: p.psnr).result
            reason = "seconds" if self.left() < seconds else result.stop_reason
        took = time.perf_counter() - self.started
        return result._replace(stop_reason=reason, seconds=took, target_reached=bool(enough))

    def next_count(self, probes: list[_Probe], slope: float) -> int | None:
        """Return how many to try next; None: the answer is known."""
        high = min((p for p in probes if p.psnr >= self.target), key=lambda p: p.count, default=None)
        low = max((p for p in probes if p.psnr < self.target), key=lambda p: p.count, default=None)
        if high is None:
            assert low is not None
            if low.count >= self.most:
                return None
            octaves = max((self.target - low.psnr) / slope, math.log2(_CLOSE))
            return max(low.count + 1, self.within(low.count * 2.0**octaves))
        if high.count == 1:
            return None
        if low is None or low.count >= high.count:
            octaves = (high.psnr - self.target) / slope
            return None if octaves < math.log2(_EXPECTED) else min(high.count - 1, self.within(high.count / 2**octaves))
        if low.count == high.count - 1 or high.count / low.count <= _CLOSE:
            return None
        slope = _slope((low.count, low.psnr), (high.count, high.psnr))
        if (high.psnr - self.target) / slope < math.log2(_EXPECTED):
            return None
        between = low.count * 2 ** ((self.target - low.psnr) / slope)
        if len(probes) > 3:  # on a curve that bends, the secant stays at one end
            between = math.sqrt(between * math.sqrt(low.count * high.count))
        return min(max(round(between), low.count + 1), high.count - 1)


def _slope(first: tuple[int, float], second: tuple[int, float]) -> float:
    octaves = math.log2(second[0] / first[0])
    slope = (second[1] - first[1]) / octaves if octaves else _SLOPE
    return min(max(slope, _LEAST_SLOPE), _MOST_SLOPE)


def _ratio(a: int, b: int) -> float:
    return max(a, b) / min(a, b)
