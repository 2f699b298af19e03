"""The paper's experiments: arithmetic, budgets, files; each in its quick form, and what they are asked wrongly."""

from __future__ import annotations

import csv
import math
import time
from pathlib import Path
from typing import Any

import pytest
import torch

import kcgs.bench
from kcgs.bench.fits import HERE
from kcgs.bench.paper import ablation, charts, convergence, davis, figures, tables
from kcgs.bench.paper.compare import Curve, complete, equal_bits, equal_n
from kcgs.bench.paper.methods import BASELINE, BEST, CLAMPED, PAPER, PAPER_CLAMPED, UNCLAMPED
from kcgs.bench.paper.options import Options
from kcgs.bench.paper.peers import codec
from kcgs.bench.paper.pictures import load, sequences
from kcgs.bench.paper.siren import BYTES_A_WEIGHT, train, weights_of, width_for
from kcgs.bench.paper.tables import Contest
from kcgs.bench.paper.trials import Row, Store, Trial, _learn, near, plan, rivals
from kcgs.fit import HistoryEntry

CONTEST = Contest("best", "best-baseline")


def row(picture: str = "a", n: int = 100, method: str = "best", psnr: float = 30.0, **values: Any) -> Row:
    fixed: dict[str, Any] = {
        "ms_ssim": 0.9, "ef_psnr": psnr - 1, "ef_ssim": 0.8, "seconds": 1.0, "core_seconds": 1.0, "num_gaussians": n,
        "pixels": 8_000, "bytes": 1_000, "map_bytes": 100, "decoded_psnr": psnr - 0.1, "decoded_ms_ssim": 0.9,
        "decoded_ef_psnr": psnr - 1.1, "decoded_ef_ssim": 0.8, "scene": "", "seed": 0, "iterations": 700,
    }  # fmt: skip
    return Row(picture=picture, n=n, method=method, psnr=psnr, **{**fixed, **values})


class TestCompare:
    def test_pairs(self) -> None:
        rows = [row("a", psnr=30.5), row("b", psnr=31.0), row("c", psnr=40.0)]
        rows += [row("a", method="best-baseline"), row("b", method="best-baseline", psnr=31.5)]
        found = equal_n(rows, *CONTEST, 100, "psnr")
        assert found is not None and found.values == {"a": 0.5, "b": -0.5} and found.worst == ["b", "a"]
        assert (found.mean, found.wins, found.losses) == (0.0, 1, 1) and math.isnan(found.low)
        assert complete(rows, CONTEST, 100) == ["a", "b"]
        assert equal_n(rows, *CONTEST, 200, "psnr") is None

    def test_five_pictures_have_an_interval(self) -> None:
        rows = [row(p, psnr=30.0 + i) for i, p in enumerate("abcde")] + [
            row(p, method="best-baseline") for p in "abcde"
        ]
        found = equal_n(rows, *CONTEST, 100, "psnr")
        assert found is not None and found.mean == 2.0 and 0.0 < found.low < 2.0 < found.high

    def test_seeds_are_averaged_before_pairs_are_made(self) -> None:
        rows = [row(psnr=30.0), row(psnr=32.0, seed=1), row(method="best-baseline", psnr=30.5)]
        found = equal_n(rows, *CONTEST, 100, "psnr")
        assert found is not None and found.values == {"a": 0.5}

    def test_curve(self) -> None:
        curve = Curve([(100.0, 20.0), (400.0, 24.0)])
        assert curve.at(200.0) == pytest.approx(22.0) and curve.at(100.0) == 20.0 and curve.at(400.0) == 24.0
        assert math.isnan(curve.at(99.0)) and math.isnan(curve.at(401.0)) and math.isnan(Curve([]).at(5.0))

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
        lines = tables.differences(rows, [CONTEST], [100]).splitlines()
        assert "equal N | 2 | +1.00" in lines[2] and "equal bits | 1 of 2 |  |" in lines[3]
        assert tables.unpaid(rows, *CONTEST) == "Nothing to compare."

    def test_unpaid(self) -> None:
        rows = [row(p, psnr=31.0) for p in "abcde"]
        for low, word in ((29.0, "pays for itself in PSNR"), (31.5, "does not pay for itself in PSNR")):
            others = [
                row(p, method="best-baseline", psnr=low + 0.01 * i + (b > 1_000), bytes=b, n=n)
                for i, p in enumerate("abcde")
                for b, n in ((1_000, 100), (2_000, 200))
            ]
            text = tables.unpaid([*rows, *others], *CONTEST)
            assert word in text and "10.0 % of the bytes" in text

    def test_pictures_that_are_drawn(self) -> None:
        rows = [row(p, n=n, method=m) for p in "abc" for n in (10, 20) for m in CONTEST if (p, n) != ("c", 20)]
        rows += [row("a", n=30, method=m) for m in CONTEST] + [row("b", n=40)]
        assert figures.sweep(rows, CONTEST) == ([10, 20], ["a", "b"])

    def test_words(self) -> None:
        rows = [row("a"), row("b", psnr=29.0)] + [row(p, method="best-baseline", psnr=29.5) for p in "ab"]
        lines = tables.losses(rows, [CONTEST]).splitlines()
        assert lines[0] == "- best - best-baseline, equal N, N = 100, PSNR: 1 of 2: b -0.50"
        assert tables.losses([row(), row(method="best-baseline", psnr=20.0)], [CONTEST]) == "Nowhere."
        assert "0.30 dB here (b, N = 100, best)" in tables.rounding([rows[0], row("b", decoded_psnr=29.7)])
        assert "| 100 | best - best-baseline | equal N | 2 | +0.00 |" in tables.differences(rows, [CONTEST])


class TestConvergence:
    def test_against_paper(self) -> None:
        history = tuple(HistoryEntry(i, 10.0 * i, 0.0, 20.0 + i, 19.0 + i, 5) for i in range(1, 6))
        paper = row(method="paper", psnr=24.0, ef_psnr=23.0, seconds=50.0, core_seconds=25.0, history=history)
        ours = row(psnr=25.0, seconds=40.0, core_seconds=40.0, history=history, ef_psnr=30.0)
        found = [convergence.in_core_seconds(r) for r in (paper, ours)]
        assert [entry.seconds for entry in found[0].history] == [5.0, 10.0, 15.0, 20.0, 25.0]
        text = convergence.against_paper(found)
        assert "took 25 s and ends at 24.00 dB" in text
        assert "| best | 40 | 1 | 40 | 1 | 40 | +1.00 | +7.00 |" in text
        assert "| best | 700 | 10 | 20 | 40 | 50 | 40 | 25.00 |" in convergence.reached(found, "psnr")


class TestAblation:
    def test_printed_figures_stand_beside_ours(self) -> None:
        rows = [row(p, n=1_250, method=m.name, psnr=20.0 + i) for p in "ab" for i, m in enumerate(ablation.PAPER_ROWS)]
        lines = ablation.paper_table(rows).splitlines()
        assert len(lines) == 2 + 6 and "| 20.00 | +0.00 | 19.00 | +0.00 |" in lines[2] and "27.10" in lines[2]
        assert "| 25.00 | +5.00 | 24.00 | +5.00 |" in lines[-1] and "27.31 | +0.21" in lines[-1]
        rows = [row(p, n=1_250, method=m.name, psnr=30.0 - i) for p in "ab" for i, m in enumerate(ablation.OUR_ROWS)]
        assert "-1.00" in ablation.our_table(rows).splitlines()[3]


class TestPlan:
    def test_published_recipes_have_their_iterations(self) -> None:
        found = plan(["a"], [10], [BEST, PAPER], iterations=123, seeds=2)
        assert [(t.method, t.seed, t.config().iterations) for t in found] == [
            (m, s, i) for s in (0, 1) for m, i in ((BEST, BEST.config().iterations), (PAPER, 123))
        ]

    def test_conditions(self) -> None:
        for method, guidance, clamp in (
            (CLAMPED, False, True),
            (UNCLAMPED, False, False),
            (PAPER_CLAMPED, True, True),
            (PAPER, True, False),
        ):
            config = method.config()
            assert (config.guidance, config.clamp) == (guidance, clamp) and config.iterations == 50_000
        switches = [(m.config().guidance, m.config().warmup, m.config().clamp) for m in ablation.PAPER_ROWS]
        assert len(set(switches)) == 6 and not BASELINE.config().guidance
        assert len({m.config() for m in ablation.OUR_ROWS}) == len(ablation.OUR_ROWS)
        assert set(ablation.PRINTED) == {m.name for m in ablation.PAPER_ROWS}

    def test_complete_sequences_first(self) -> None:
        stages = davis._stages(["a", "b"], Options(budget_seconds=1.0))
        assert [(t.picture, t.n) for t in stages[0]] == [("a", n) for n in (1_250, 7_500) for _ in davis.METHODS]
        assert {t.picture for t in stages[1]} == {"b"} and {t.n for t in stages[2]} == {500}
        assert sum(map(len, stages)) == 2 * 6 * len(davis.METHODS)

    def test_sequences(self) -> None:
        assert sequences(None, None, quick=True) == ["astronaut", "disc"]
        with pytest.raises(ValueError, match="sequences must name some of astronaut, disc; got 'dog'"):
            sequences(None, "dog", quick=True)
        with pytest.raises(ValueError, match="data must name a folder with DAVIS in it"):
            sequences(None, None, quick=False)


class TestStore:
    def test_budget_and_resuming(self, tmp_path: Path) -> None:
        store = Store(tmp_path / "runs", None)
        trials = plan(["disc"], [5], [UNCLAMPED, CLAMPED], iterations=3, stride=8, quick=True)
        assert store.obtain(trials, HERE, time.monotonic() - 1) == [] and store.rows(trials) == []
        store.make(trials[0])
        assert [r.method for r in store.rows(trials)] == ["gaussian-image"]
        made = store.read(trials[0])
        assert made is not None and made.bytes > 0 and made.decoded_psnr > made.psnr - 1
        # as long as the last one took is more than is left
        _learn(store.folder, trials[1], 100.0)
        assert store.obtain(trials, HERE, time.monotonic() + 60) == [] and len(store.rows(trials)) == 1
        assert store.obtain(trials, HERE, time.monotonic() + 200) == [] and len(store.rows(trials)) == 2
        assert store.read(trials[0]) == made
        assert store._expected(trials[0]._replace(picture="other")) > 0
        (store.folder / made.scene).unlink()
        assert store.read(trials[0]) is None  # a row without its scene cannot be drawn

    def test_rivals_come_near(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        store, (ours, base) = Store(tmp_path, None), plan(["a"], [20], [BEST, BASELINE], iterations=1)
        rows = {ours: row(n=20, bytes=1_000), base: row(n=20, method=BASELINE.name, bytes=200)}
        monkeypatch.setattr(store, "read", rows.get)
        for _ in range(4):  # bytes are not proportional to N
            wanted = rivals(store, [ours, base], BEST, BASELINE)
            for trial in wanted:
                rows.setdefault(trial, row(n=trial.n, method=BASELINE.name, bytes=100 + 5 * trial.n))
        sizes = [rows[trial].bytes for trial in wanted]
        assert 1 < len(sizes) <= 4 and 1_000 <= sizes[-1] <= 1_060
        found = near(rows.values(), rows[ours], BASELINE.name)
        assert found is not None and found.bytes == sizes[-1]
        rows[ours] = row(n=20, bytes=205)  # with as many Gaussians it has as many bytes
        assert rivals(store, [ours, base], BEST, BASELINE) != [] and near([], rows[ours], BASELINE.name) is None
        rows[ours] = row(n=20, bytes=195)
        assert rivals(store, [ours, base], BEST, BASELINE) == []

    def test_keys(self, tmp_path: Path) -> None:
        store, trial = Store(tmp_path, None), Trial("disc", 5, BEST)
        others = [trial._replace(n=6), trial._replace(method=PAPER), trial._replace(seed=1), trial._replace(stride=2)]
        assert len({store._path(t) for t in [trial, *others, trial._replace(iterations=9)]}) == 6


class TestPeers:
    def test_network_fits(self) -> None:
        width = width_for(2_000)
        assert BYTES_A_WEIGHT * weights_of(width) <= 2_000 < BYTES_A_WEIGHT * weights_of(width + 1)
        image = torch.linspace(0, 1, 48).expand(3, 32, 48)
        made = train(image, 2_000, seconds=0.2)
        assert made.picture.shape == image.shape and made.bytes <= 2_000 and made.iterations > 0
        before = torch.random.get_rng_state()
        train(image, 100, seconds=0.01)
        assert torch.equal(torch.random.get_rng_state(), before)

    def test_codec(self) -> None:
        image, labels = load("disc", None, 4)
        small, large = (codec("JPEG", image, labels, size) for size in (1_500, 6_000))
        assert small.bytes <= 1_500 and large.bytes <= 6_000 and small.psnr < large.psnr and not small.note
        assert codec("JPEG", image, labels, 10).note == "its smallest file is larger"


@pytest.mark.parametrize("name", ["charts", "davis", "ablation", "convergence"])
def test_quick(tmp_path: Path, name: str) -> None:
    if name != "charts":
        kcgs.bench.run(name, tmp_path, quick=True, sequences=None if name == "convergence" else "disc")
    else:
        kcgs.bench.run(name, tmp_path, quick=True)
    text = (tmp_path / "report.md").read_text()
    assert f"kcgs bench {name} -o DIR --quick" in text or "--sequences disc --quick" in text
    assert "nan" not in text.lower().replace("nanometre", "") and "Missing" not in text
    for link in text.split("![](")[1:]:
        assert (tmp_path / link.split(")")[0]).is_file()
    with (tmp_path / "results.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert all(float(line["bits_per_pixel"]) > 0 for line in lines)
    expected = {"charts": charts.NAMES, "davis": davis.NAMES, "convergence": convergence.NAMES}
    assert set(expected.get(name, ablation.SHOWN)) <= {line["method"] for line in lines}


def test_wrong_questions(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="seeds are for charts, davis, ablation, convergence; got .* for 'maps'"):
        kcgs.bench.run("maps", tmp_path / "out", seeds=2)
    assert not (tmp_path / "out").exists()
    with pytest.raises(ValueError, match="sequences are for DAVIS"):
        kcgs.bench.run("charts", tmp_path, quick=True, sequences="dog")
    with pytest.raises(ValueError, match="budget_seconds must be above 0; got -1"):
        kcgs.bench.run("davis", tmp_path, quick=True, budget_seconds=-1)


@pytest.mark.slow
def test_davis_quick_on_data(tmp_path: Path, data_root: Path) -> None:
    if not (data_root / "DAVIS").is_dir():
        pytest.skip(f"no DAVIS in {data_root}")
    kcgs.bench.run("davis", tmp_path, data=data_root, quick=True, budget_seconds=300)
    assert "- Pictures: blackswan" in (tmp_path / "report.md").read_text()
