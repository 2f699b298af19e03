"""Rows beside each other: pairs, curves, intervals, and the words made of them."""

from __future__ import annotations

import math
from typing import Any

import pytest

from benchmarks.core import summaries
from benchmarks.core.compare import Contest, complete, equal_bits, equal_n, sweep
from benchmarks.core.statistics import delta, interpolate, interval, summarize
from benchmarks.core.store import Row

CONTEST = Contest("best", "best-baseline")


def row(image: str = "a", n: int = 100, method: str = "best", psnr: float = 30.0, **values: Any) -> Row:
    fixed: dict[str, Any] = {
        "ms_ssim": 0.9, "ef_psnr": psnr - 1, "ef_ssim": 0.8, "seconds": 1.0, "core_seconds": 1.0, "num_gaussians": n,
        "pixels": 8_000, "bytes": 1_000, "map_bytes": 100, "decoded_psnr": psnr - 0.1, "decoded_ms_ssim": 0.9,
        "decoded_ef_psnr": psnr - 1.1, "decoded_ef_ssim": 0.8, "seed": 0, "iterations": 700,
    }  # fmt: skip
    return Row(image=image, n=n, method=method, psnr=psnr, **{**fixed, **values})


class TestCompare:
    def test_pairs(self) -> None:
        rows = [row("a", psnr=30.5), row("b", psnr=31.0), row("c", psnr=40.0)]
        rows += [row("a", method="best-baseline"), row("b", method="best-baseline", psnr=31.5)]
        found = equal_n(rows, *CONTEST, 100, "psnr")
        assert found is not None and found.values == {"a": 0.5, "b": -0.5} and found.worst == ["b", "a"]
        assert (found.mean, found.wins, found.losses) == (0.0, 1, 1) and math.isnan(found.low)
        assert complete(rows, CONTEST, 100) == ["a", "b"]
        assert equal_n(rows, *CONTEST, 200, "psnr") is None

    def test_five_images_have_an_interval(self) -> None:
        rows = [row(p, psnr=30.0 + i) for i, p in enumerate("abcde")]
        rows += [row(p, method="best-baseline") for p in "abcde"]
        found = equal_n(rows, *CONTEST, 100, "psnr")
        assert found is not None and found.mean == 2.0 and 0.0 < found.low < 2.0 < found.high

    def test_seeds_are_averaged_before_pairs_are_made(self) -> None:
        rows = [row(psnr=30.0), row(psnr=32.0, seed=1), row(method="best-baseline", psnr=30.5)]
        found = equal_n(rows, *CONTEST, 100, "psnr")
        assert found is not None and found.values == {"a": 0.5}

    def test_equal_bits(self) -> None:
        rows = [row(psnr=31.0, bytes=1_000)]
        rows += [row(method="best-baseline", psnr=p, bytes=b, n=n) for p, b, n in ((30.0, 500, 50), (32.0, 2_000, 200))]
        found = equal_bits(rows, *CONTEST, 100, "psnr")
        assert found is not None and found.mean == pytest.approx(0.0)
        assert equal_bits(rows[:2], *CONTEST, 100, "psnr") is None  # nothing to interpolate between

    def test_no_mean_of_what_happens_to_be_there(self) -> None:
        rows = [row(p, psnr=31.0) for p in "ab"]
        rows += [row("a", method="best-baseline", psnr=30.0, bytes=b, n=n) for b, n in ((500, 100), (2_000, 200))]
        rows += [row("b", method="best-baseline", psnr=30.0, bytes=b, n=n) for b, n in ((1_500, 100), (2_000, 200))]
        found = equal_bits(rows, *CONTEST, 100, "psnr")
        assert found is not None and list(found.values) == ["a"] and found.asked == 2 and not found.is_complete
        lines = summaries.differences(rows, [CONTEST], [100]).splitlines()
        assert "equal N | 2 | +1.00" in lines[2] and "equal bits | 1 of 2 |  |" in lines[3]

    def test_images_that_figures_show(self) -> None:
        rows = [row(p, n=n, method=m) for p in "abc" for n in (10, 20) for m in CONTEST if (p, n) != ("c", 20)]
        rows += [row("a", n=30, method=m) for m in CONTEST] + [row("b", n=40)]
        assert sweep(rows, CONTEST) == ([10, 20], ["a", "b"])

    def test_words(self) -> None:
        rows = [row("a"), row("b", psnr=29.0)] + [row(p, method="best-baseline", psnr=29.5) for p in "ab"]
        lines = summaries.losses(rows, [CONTEST]).splitlines()
        assert lines[0] == "- best - best-baseline, equal N, N = 100, PSNR: 1 of 2: b -0.50"
        assert summaries.losses([row(), row(method="best-baseline", psnr=20.0)], [CONTEST]) == "Nowhere."
        assert "| 100 | best - best-baseline | equal N | 2 | +0.00 |" in summaries.differences(rows, [CONTEST])


class TestStatistics:
    def test_interval(self) -> None:
        values = [0.1, 0.2, 0.3, 0.9]
        low, high = interval(values)
        assert -0.3 < low < 0.1 and 0.9 < high < 1.1  # Student's is -0.19 to 0.94; the values are skew
        assert interval(values) == (low, high) and interval([0.3]) == pytest.approx((0.3, 0.3))

    def test_summary(self) -> None:
        found = summarize({"a": 0.5, "b": -0.25, "c": 0.003, "d": math.nan}, 0.005)
        assert found is not None and found.mean == pytest.approx(0.253 / 3) and found.asked == 4
        assert (found.wins, found.losses, found.worst[0]) == (1, 1, "b")
        assert summarize({"a": math.nan}, 0.005) is None

    def test_interpolation(self) -> None:
        curve = [(100.0, 20.0), (400.0, 24.0)]
        assert interpolate(curve, 200.0) == pytest.approx(22.0)
        assert interpolate(curve, 100.0) == 20.0 and interpolate(curve, 400.0) == 24.0
        assert all(math.isnan(value) for value in (interpolate(curve, 99.0), interpolate([], 5.0)))


class TestBjontegaard:
    curve = tuple((1000.0 * 2**i, 25.0 + 3 * i) for i in range(5))

    def test_half_the_bits(self) -> None:
        found = delta([(r / 2, q) for r, q in self.curve], self.curve)
        assert found.rate == pytest.approx(-50) and found.quality == pytest.approx(3) and found.overlap == 12

    def test_better_by_a_constant(self) -> None:
        found = delta([(r, q + 1) for r, q in self.curve], self.curve)
        assert found.quality == pytest.approx(1) and found.rate == pytest.approx(100 * (2 ** (-1 / 3) - 1))
        back = delta(self.curve, [(r, q + 1) for r, q in self.curve])
        assert back.quality == pytest.approx(-1) and back.rate == pytest.approx(100 * (2 ** (1 / 3) - 1))

    def test_curves_apart(self) -> None:
        found = delta([(r, q + 50) for r, q in self.curve], self.curve)
        assert math.isnan(found.rate) and found.overlap == 0 and found.quality == pytest.approx(50)
        found = delta([(r * 1e6, q) for r, q in self.curve], self.curve)
        assert math.isnan(found.quality) and found.rate > 0

    def test_files_that_are_no_part_of_the_curve(self) -> None:
        noise = [(1500.0, 24.0), (2000.0, 20.0), self.curve[0], (16000.0, 36.0)]
        assert delta([*self.curve, *noise], self.curve) == delta(self.curve, self.curve)
        assert math.isnan(delta(self.curve[:1], self.curve).rate)
