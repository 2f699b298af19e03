"""When things happen: additions, learning rates, the search for the fewest Gaussians; moves of contours."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from typing import Any

import pytest
import torch

from kcgs import FitConfig, RegionMap
from kcgs.fitting.contour_moves import accept_moves
from kcgs.fitting.events import Densify, SettleContours
from kcgs.fitting.problem import make_problem
from kcgs.fitting.result import HistoryEntry
from kcgs.fitting.start import make_optimizer, start
from kcgs.fitting.state import FitState
from kcgs.nn import GaussianField


def state_of(num_gaussians: int, **settings: Any) -> FitState:
    return start(make_problem(torch.rand(1, 8, 8), None, num_gaussians, FitConfig(**settings), 0))


def targets(progress: Iterable[float], **settings: Any) -> list[int]:
    """How many Gaussians the schedule asks for, of at most 60."""
    state, counts = state_of(60, **settings), []
    for state.progress in progress:
        counts.append(Densify().target(state, state.num_initial))
    return counts


class TestDensify:
    def test_the_number_grows_and_then_goes_up_and_down(self) -> None:
        counts = targets(p / 1000 for p in range(1001))
        assert counts[0] == counts[49] == 1
        growth, cycles, rest = counts[:401], counts[400:800], counts[800:]
        assert all(b >= a for a, b in pairwise(growth))
        assert len(set(growth)) == Densify.steps + 1
        assert growth[-1] == max(counts) == 72
        assert sum(b > a for a, b in pairwise(cycles)) == 2  # three cycles in 700 iterations
        assert min(cycles) == cycles[-1] == 60
        assert set(rest) == {60}

    @pytest.mark.parametrize(("iterations", "cycles"), [(100, 0), (2800, 10)])
    def test_longer_fits_have_more_cycles(self, iterations: int, cycles: int) -> None:
        counts = targets((p / 1000 for p in range(400, 1000)), iterations=iterations)
        assert sum(b > a for a, b in pairwise(counts)) == cycles

    def test_a_clock_does_not_change_the_number_of_cycles(self) -> None:
        """Iterations of a fit that a clock ends take more and less time."""
        state, densify = state_of(60, max_seconds=9.0), Densify()
        state.history.append(HistoryEntry(0, 0.0, 1.0, 10.0, 10.0, 5))
        for state.iteration, state.progress in ((400, 0.41), (900, 0.5), (300, 0.6)):
            densify.act(state)
            assert state.num_cycles == 4


class TestLearningRates:
    def rates(self, progress: float, factor: float = 1.0, iterations: int = 12_500, **settings: Any) -> list[float]:
        config = FitConfig(learning_rate_factor=factor, iterations=iterations, **settings)
        problem = make_problem(torch.rand(1, 8, 8), None, 3, config, 0)
        optimizer = make_optimizer(problem, GaussianField.random(3, (8, 8), seed=0), 2.0)
        return [float(group["lr"]) * optimizer.rate(progress) for group in optimizer.param_groups]

    def test_ours_fall_to_a_tenth(self) -> None:
        geometry, colors = zip(*(self.rates(p / 10) for p in range(11)), strict=True)
        assert geometry[0] == pytest.approx(0.14) and geometry[-1] == pytest.approx(0.014)
        assert colors[0] == pytest.approx(0.03) and colors[-1] == pytest.approx(0.003)
        assert all(b < a for a, b in pairwise(geometry))

    def test_those_of_gaussian_image_halve_and_are_larger_in_short_fits(self) -> None:
        rates = [self.rates(p, optimizer="adan") for p in (0.0, 0.39, 0.4, 0.8, 1.0)]
        assert rates == [[f * 2e-3, f * 4e-3, f * 2e-3] for f in (1, 1, 0.5, 0.25, 0.25)]
        assert self.rates(0.0, iterations=1, optimizer="adan") == [2e-2, 4e-2, 2e-2]

    @pytest.mark.parametrize("optimizer", ["gaussian-adam", "adan"])
    def test_the_factor_scales_all(self, optimizer: str) -> None:
        once, thrice = (self.rates(0.5, factor, optimizer=optimizer) for factor in (1.0, 3.0))
        assert thrice == pytest.approx([3 * rate for rate in once])


def test_late_moves_are_even() -> None:
    state, event, counts = state_of(10), SettleContours(after=0.5), []
    for p in range(101):
        state.progress = p / 100
        event.act(state)
        counts.append(state.num_late_moves)
    assert [p / 100 for p in range(1, 101) if counts[p] > counts[p - 1]] == [0.6, 0.7, 0.8, 0.9]


class TestMaps:
    def test_moves_are_kept_group_by_group(self) -> None:
        before = RegionMap((torch.arange(30) > 14).long().expand(40, 30).clone())
        labels = before.labels.clone()
        labels[3:6, 15:17] = 0
        labels[30:33, 13:15] = 1
        gain = torch.zeros(40, 30)
        gain[1], gain[28] = 1.0, -1.0  # two pixels above a group
        accepted = accept_moves(before, RegionMap(labels), gain).labels
        assert torch.equal(accepted[:20], labels[:20])
        assert torch.equal(accepted[20:], before.labels[20:])

    def test_a_region_is_never_lost(self) -> None:
        labels = torch.zeros(20, 20, dtype=torch.long)
        labels[5:7, 5:7], labels[12:, 12:] = 1, 2
        after = torch.where(labels == 1, 0, labels)
        after[0, 0] = 1  # elsewhere, where it does not pay
        gain = torch.ones(20, 20)
        gain[:3, :3] = -1.0
        before = RegionMap(labels)
        assert accept_moves(before, RegionMap(after), gain) is before
