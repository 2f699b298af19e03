"""Fits on disk: what names them, what is made again, what a budget allows, files of as many bytes."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch

from benchmarks._codecs import lossless_bytes
from benchmarks.core.cases import BASELINE, BEST, CLAMPED, PAPER, UNCLAMPED, Case, plan
from benchmarks.core.images import load, sequences
from benchmarks.core.jobs import Place, check_made, make_all
from benchmarks.core.options import Options
from benchmarks.core.readings import Readings
from benchmarks.core.rows import read_rows, write_rows
from benchmarks.core.stages import rivals
from benchmarks.core.store import Row, Store

HERE = Place()
QUICK = Options(quick=True)


def row(n: int, size: int, method: str = "best", **values: Any) -> Row:
    return Row("a", n, method, 0, 700, *[0.0] * 6, n, 8_000, size, 0, *[0.0] * 4, **values)


class TestStore:
    def test_budget_and_resuming(self, tmp_path: Path) -> None:
        store = Store(tmp_path / "runs", None)
        cases = plan(["disc"], [5], [UNCLAMPED, CLAMPED], QUICK, 3, 8)
        assert store.obtain(cases, HERE, time.monotonic() - 1) == [] and store.rows(cases) == []
        store.make(cases[0])
        assert [r.method for r in store.rows(cases)] == ["gaussian-image"]
        made = store.kept(cases[0])
        assert made is not None and made.row.bytes > 0 and made.row.decoded_psnr > made.row.psnr - 1
        assert made.history[-1].iteration == made.row.iterations and made.given_regions == 2
        scene = store.scene(cases[0])
        assert scene.num_gaussians == made.row.num_gaussians
        # as long as the last one took is more than is left
        store._learn(cases[1], 100.0)
        assert store.obtain(cases, HERE, time.monotonic() + 60) == [] and len(store.rows(cases)) == 1
        assert store.obtain([*cases, *cases], HERE, time.monotonic() + 1e9) == [] and len(store.rows(cases)) == 2
        assert store.kept(cases[0]) == made
        assert store._known()[cases[0]._replace(image="other").settings()] > 0
        store._path(cases[0]).with_suffix(".safetensors").unlink()
        assert store.row(cases[0]) is None  # a row without its scene cannot be shown

    def test_names(self, tmp_path: Path) -> None:
        store, case = Store(tmp_path, None), Case("disc", 5, BEST)
        changes: list[dict[str, Any]] = [
            {"n": 6}, {"method": PAPER}, {"seed": 1}, {"stride": 2}, {"iterations": 9}, {"image": "pie"},
            {"source": "slic"}, {"factor": 2},
        ]  # fmt: skip
        paths = {store._path(case._replace(**change)) for change in changes}
        assert len({store._path(case), Store(tmp_path, tmp_path)._path(case), *paths}) == 2 + len(changes)

    def test_the_others_are_kept(self, tmp_path: Path) -> None:
        store = Store(tmp_path, None)
        wrong, right = plan(["disc"], [0, 4], [UNCLAMPED], QUICK, 3, 8)
        failed = store.obtain([wrong, right], HERE)
        with pytest.raises(RuntimeError, match="fits failed, 1 of them: disc, N = 0, gaussian-image: ValueError"):
            check_made(failed)
        assert len(store.rows([wrong, right])) == 1

    def test_rivals_come_near(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        store, (ours, base) = Store(tmp_path, None), plan(["a"], [20], [BEST, BASELINE], Options(), 1, 1)
        rows = {ours: row(20, 1_000), base: row(20, 200, BASELINE.name)}
        monkeypatch.setattr(store, "row", rows.get)
        for _ in range(4):  # bytes are not proportional to N
            wanted = rivals(store, [ours, base], BEST, BASELINE)
            for case in wanted:
                rows.setdefault(case, row(case.n, 100 + 5 * case.n, BASELINE.name))
        sizes = [rows[case].bytes for case in wanted]
        assert 1 < len(sizes) <= 4 and 1_000 <= sizes[-1] <= 1_060
        rows[ours] = row(20, 205)  # with as many Gaussians it has as many bytes
        assert rivals(store, [ours, base], BEST, BASELINE) != []
        rows[ours] = row(20, 195)
        assert rivals(store, [ours, base], BEST, BASELINE) == []


class TestCases:
    def test_published_recipes_have_their_iterations(self) -> None:
        found = plan(["a"], [10], [BEST, PAPER], Options(seeds=2), 123, 4)
        assert [(c.method, c.seed, c.config().iterations, c.stride) for c in found] == [
            (m, s, i, 1) for s in (0, 1) for m, i in ((BEST, BEST.config().iterations), (PAPER, 123))
        ]

    def test_sequences(self) -> None:
        assert sequences(None, None, quick=True) == ["astronaut", "disc"]
        with pytest.raises(ValueError, match="sequences must name some of astronaut, disc; got 'dog'"):
            sequences(None, "dog", quick=True)
        with pytest.raises(ValueError, match="data must name a folder with DAVIS in it"):
            sequences(None, None, quick=False)

    def test_without_a_map(self) -> None:
        sample = load("disc", None, 4)
        assert sample.labels is not None and sample.image.shape == (3, 80, 100)
        regions = Case("disc", 5, BEST).regions(sample.labels)
        assert regions is not None and torch.equal(regions.labels, sample.labels)
        assert Case("disc", 5, BEST).regions(None) is None


class TestJobs:
    def test_words(self) -> None:
        assert str(HERE) == "one at a time on one thread"
        assert str(Place(workers=3)) == "3 at a time on one thread each, engine local"
        assert "processors" in str(Place("ray"))

    def test_make_all(self) -> None:
        assert make_all(int, ["1", "x"], HERE)[0].startswith("x: ValueError")
        assert make_all(int, [], HERE) == []
        check_made([])


class TestReadings:
    class Reading(NamedTuple):
        case: str
        quantity: str
        value: float
        unit: str

    rows = (Reading("a", "time", 1.0, "ms"), Reading("b", "time", 2.0, "ms"), Reading("b", "memory", 3.5, "MB"))

    def test_table(self) -> None:
        readings = Readings(self.rows)
        assert readings.value(case="b", quantity="time") == 2.0 and math.isnan(readings.value(case="c"))
        assert readings.names("case") == ["a", "b"]
        lines = ["| case | time, ms | memory, MB |", "| --- | --- | --- |", "| a | 1 |  |", "| b | 2 | 3.5 |"]
        assert readings.table("case").splitlines() == lines

    def test_file(self, tmp_path: Path) -> None:
        write_rows(tmp_path / "results.csv", self.Reading, self.rows)
        assert read_rows(tmp_path / "results.csv", self.Reading) == list(self.rows)
        assert read_rows(tmp_path / "nothing.csv", self.Reading) == []


def test_a_lossless_map_costs_no_ids() -> None:
    halves = (torch.arange(64) > 30).long().expand(64, 64)
    assert 20 < lossless_bytes(halves) == lossless_bytes(7 * halves) < 100
