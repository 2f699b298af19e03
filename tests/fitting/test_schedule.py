"""When things happen: additions, learning rates, the search for the fewest Gaussians; moves of contours."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest
import torch

from kcgs import FitConfig, RegionMap
from kcgs.fitting.contour_moves import accept_moves
from kcgs.fitting.optimizers import FrameAdam, GaussianImageAdan
from kcgs.fitting.start import start
from kcgs.fitting.state import FitState, HistoryEntry
from kcgs.fitting.strategies import Densify, MoveContours, Strategy, make_strategies
from kcgs.nn import GaussianField


def state_of(num_gaussians: int, started: float = 0.0, **settings: Any) -> FitState:
    return start(torch.rand(1, 8, 8), None, num_gaussians, FitConfig(**settings), 0, started)


class TestDensify:
    def test_the_number_grows_and_then_goes_up_and_down(self) -> None:
        densify = Densify(state_of(1000))
        counts = [densify.wanted(p / 1000) for p in range(1001)]
        assert counts[0] == counts[49] == 10
        growth, cycles, rest = counts[:401], counts[400:800], counts[800:]
        assert all(b >= a for a, b in pairwise(growth))
        assert len(set(growth)) == densify.steps + 1
        assert growth[-1] == max(counts) == 1200
        assert sum(b > a for a, b in pairwise(cycles)) == 2  # three cycles in 700 iterations
        assert min(cycles) == cycles[-1] == 1000
        assert set(rest) == {1000}

    def test_longer_fits_have_more_cycles(self) -> None:
        def cycles(iterations: int) -> int:
            densify = Densify(state_of(1000, iterations=iterations))
            return sum(b > a for a, b in pairwise(densify.wanted(p / 10_000) for p in range(4000, 10_000)))

        assert [cycles(n) for n in (100, 700, 2800)] == [0, 2, 10]

    def test_is_due_where_more_are_wanted(self) -> None:
        state = state_of(100)
        densify = Densify(state)
        assert not densify.due(0.05)  # nothing is logged yet
        state.history.append(HistoryEntry(0, 0.0, 1.0, 10.0, 10.0, 5))
        assert not densify.due(0.04)
        assert densify.due(0.05)


class TestLearningRates:
    def test_ours_falls_to_a_tenth(self) -> None:
        optimizer = FrameAdam(GaussianField.random(3, (8, 8), seed=0), 1.0)
        rates = [optimizer.decay(p / 10) for p in range(11)]
        assert rates[0] == 1
        assert rates[-1] == pytest.approx(optimizer.final_decay)
        assert all(b < a for a, b in pairwise(rates))

    def test_the_published_one_halves_and_is_larger_in_short_fits(self) -> None:
        field = GaussianField.random(3, (8, 8), seed=0)
        optimizer = GaussianImageAdan(field, 2.0, 12_500, 1.0)
        assert [optimizer.decay(p) for p in (0.0, 0.39, 0.4, 0.8, 1.0)] == [1, 1, 0.5, 0.25, 0.25]
        assert optimizer.rates == [2e-3, 4e-3, 2e-3]
        assert GaussianImageAdan(field, 1.0, 1, 1.0).rates == [2e-2] * 3

    def test_the_factor_scales_all(self) -> None:
        field = GaussianField.random(3, (8, 8), seed=0)
        for make in (lambda f: FrameAdam(field, f).rates, lambda f: GaussianImageAdan(field, 1.0, 50_000, f).rates):
            torch.testing.assert_close(torch.as_tensor(make(3.0)), 3 * torch.as_tensor(make(1.0)))


class TestProgress:
    def test_the_clock_alone_uses_all_of_its_time(self, monkeypatch: pytest.MonkeyPatch) -> None:
        state = state_of(10, max_seconds=4.0)
        monkeypatch.setattr("time.perf_counter", lambda: 1.0)
        state.iteration = 5000
        assert state.progress() == 0.25
        assert state.length() == 20_000

    def test_is_the_scarcer_of_iterations_and_seconds(self, monkeypatch: pytest.MonkeyPatch) -> None:
        state = state_of(10, max_seconds=4.0, iterations=100)
        monkeypatch.setattr("time.perf_counter", lambda: 1.0)
        state.iteration = 50
        assert state.progress() == 0.5
        monkeypatch.setattr("time.perf_counter", lambda: 3.0)
        assert state.progress() == 0.75


class TestStrategies:
    def test_are_those_that_the_settings_ask_for(self) -> None:
        def names(**settings: Any) -> list[str]:
            return [type(strategy).__name__ for strategy in make_strategies(state_of(10, **settings))]

        assert names() == ["EndDrafts", "Densify", "MoveContours"]
        assert names(warmup=True, move_contours=False) == ["EndDrafts", "RefreshIds", "Densify"]

    def test_late_moves_are_even(self) -> None:
        state, due = state_of(10), []
        strategy: Strategy = MoveContours(state, after=0.5)
        for p in range(101):
            if strategy.due(p / 100):
                state.late_moves += 1
                due.append(p / 100)
        assert due == [0.6, 0.7, 0.8, 0.9]


class TestMaps:
    def test_moves_are_kept_group_by_group(self) -> None:
        before = RegionMap.from_labels((torch.arange(30) > 14).long().expand(40, 30).clone())
        labels = before.labels.clone()
        labels[3:6, 15:17] = 0
        labels[30:33, 13:15] = 1
        gain = torch.zeros(40, 30)
        gain[:20], gain[20:] = 1.0, -1.0
        kept = accept_moves(before, RegionMap.from_labels(labels), gain).labels
        assert torch.equal(kept[:20], labels[:20])
        assert torch.equal(kept[20:], before.labels[20:])

    def test_a_region_is_never_lost(self) -> None:
        labels = torch.zeros(20, 20, dtype=torch.long)
        labels[5:7, 5:7], labels[12:, 12:] = 1, 2
        after = torch.where(labels == 1, 0, labels)
        after[0, 0] = 1  # elsewhere, where it does not pay
        gain = torch.ones(20, 20)
        gain[:3, :3] = -1.0
        before = RegionMap.from_labels(labels)
        assert accept_moves(before, RegionMap.from_labels(after), gain) is before
