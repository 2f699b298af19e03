"""When things happen: growth, learning rate, and the search for the fewest Gaussians."""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch

from kcgs import FitConfig, RegionMap
from kcgs.fit.refine import accept_moves
from kcgs.fit.release import merge_pairs, nearest_contour
from kcgs.fit.schedule import COSINE_END, DENSIFY_STEPS, Schedule, TargetSchedule, make_schedule


def config(**settings: object) -> FitConfig:
    return FitConfig.from_recipe("best", **settings)


class TestSchedule:
    def test_growth_is_even_and_ends_at_n(self) -> None:
        schedule = Schedule(config(), 1000, 50)
        counts = [schedule.wanted(p / 1000) for p in range(1001)]
        assert counts[0] == counts[49] == 50
        assert counts[-1] == schedule.wanted(0.5) == 1000
        assert len(set(counts)) == DENSIFY_STEPS + 1
        assert all(b >= a for a, b in pairwise(counts))

    def test_rate_falls_from_one_to_decay(self) -> None:
        schedule = Schedule(config(), 10, 10)
        rates = [schedule.rate(p / 10) for p in range(11)]
        assert rates[0] == 1
        assert rates[-1] == pytest.approx(COSINE_END)
        assert all(b < a for a, b in pairwise(rates))

    def test_progress_is_the_scarcer_of_iterations_and_seconds(self) -> None:
        schedule = Schedule(config(max_seconds=4.0, iterations=100), 10, 10)
        assert schedule.progress(50, 1.0) == 0.5
        assert schedule.progress(10, 3.0) == 0.75


class TestTarget:
    def test_only_recipes_that_grow_search(self) -> None:
        assert isinstance(make_schedule(config(target_psnr=30.0), 100, 5), TargetSchedule)
        assert not isinstance(make_schedule(config(target_psnr=30.0, densify_from=1.0), 100, 5), TargetSchedule)

    def test_grows_anneals_and_adds_what_is_missing(self) -> None:
        schedule = TargetSchedule(config(), 1000, 100, 30.0)
        schedule.observe(0.05, 20.0)
        assert schedule.wanted(0.05) > 100
        grown = schedule.wanted(0.1)
        schedule.observe(0.1, 29.5)
        assert schedule.rate(0.1) == 1
        schedule.observe(0.3, 29.7)
        assert schedule.wanted(0.3) == grown
        assert schedule.rate(0.3) < 1
        schedule.observe(0.51, 29.9)
        assert grown < schedule.wanted(0.51) < 1.1 * grown

    def test_never_beyond_the_most(self) -> None:
        schedule = TargetSchedule(config(), 120, 100, 60.0)
        for k in range(1, 60):
            schedule.observe(k / 20, 20.0)
        assert schedule.wanted(3.0) == 120


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
        after[0, 0] = 1  # elsewhere, and not worth it
        gain = torch.ones(20, 20)
        gain[:3, :3] = -1.0
        before = RegionMap.from_labels(labels)
        assert accept_moves(before, RegionMap.from_labels(after), gain) is before

    def test_merging(self) -> None:
        labels = torch.tensor([0, 3, 5, 9]).repeat_interleave(4).expand(6, -1)
        regions = RegionMap.from_labels(labels, {(0, 3): 1.0, (3, 5): 0.5, (5, 9): 2.0})
        ids = torch.tensor([9, 5, 3, 0])
        merged, new = merge_pairs(regions, ids, [(5, 9)])
        assert merged is not None and new is not None
        assert merged.ids.tolist() == [0, 3, 5]
        assert new.tolist() == [5, 5, 3, 0]
        assert dict(merged.softness) == {(0, 3): 1.0, (3, 5): 0.5}  # type: ignore[arg-type]
        assert merge_pairs(regions, ids, [(0, 3), (3, 5), (5, 9)]) == (None, None)
        assert merge_pairs(regions, ids, []) == (regions, ids)

    def test_nearest_contour(self) -> None:
        own, other, distance = nearest_contour(torch.tensor([[4, 4, 4, 7, 7]]))
        assert own.tolist() == [[4, 4, 4, 7, 7]]
        assert other.tolist() == [[7, 7, 7, 4, 4]]
        assert distance.tolist() == [[2, 1, 0, 0, 1]]
