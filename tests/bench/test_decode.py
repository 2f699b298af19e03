"""The benchmark of the decoders in its quick form, and its parts."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import pytest
import torch

from kcgs import GaussianField, RegionMap, RegionSplatRenderer
from kcgs.bench import run
from kcgs.bench.decode.decoders import (
    CPU,
    DECODERS,
    GENERIC,
    SCENE,
    TILED,
    Files,
    can_draw,
    open_decoder,
    truth,
    write_files,
)
from kcgs.bench.decode.findings import Findings, Row, cutoff_name
from kcgs.bench.decode.report import write
from kcgs.bench.decode.scenes import Scene, fitted_scenes, standard_scenes, why_not_fitted
from kcgs.bench.decode.timing import Entrant, opening, peak_memory, race, ratio


@pytest.fixture(scope="module")
def scenes() -> dict[str, Scene]:
    return {scene.contours: scene for scene in standard_scenes(quick=True)}


def test_standard_scenes(scenes: dict[str, Scene]) -> None:
    assert list(scenes) == ["none", "hard", "soft"]
    assert [can_draw(GENERIC, scene) for scene in scenes.values()] == [True, True, False]
    full = standard_scenes(quick=False)
    assert [scene.name for scene in full] == [f"{w} {c}" for w in ("W1", "W2") for c in ("none", "hard", "soft")]
    assert {(scene.size, len(scene.field)) for scene in full} == {((480, 854), 1_250), ((480, 854), 7_500)}
    assert full[1].regions is not None and full[1].regions.num_regions == 6


@pytest.mark.parametrize("contours", ["none", "hard", "soft"])
@pytest.mark.parametrize("factor", [1, 2])
def test_all_draw_the_same_picture(scenes: dict[str, Scene], tmp_path: Path, contours: str, factor: int) -> None:
    scene = scenes[contours]
    size = (factor * scene.size[0], factor * scene.size[1])
    files = write_files(tmp_path / "files", scene, 1e-6)
    with torch.no_grad():
        want = RegionSplatRenderer(cutoff=1e-6)(scene.field, scene.regions, size)
    assert (truth(scene, size) - want).abs().max() < 2e-5
    assert want.std() > 0.05
    for name in DECODERS:
        if can_draw(name, scene):
            picture = open_decoder(name, files, size, 1)()
            assert picture.shape == want.shape
            assert (picture - want).abs().max() < 1e-4, name


@pytest.mark.parametrize("contours", ["none", "hard", "soft"])
def test_truth_is_that_of_the_reference(scenes: dict[str, Scene], contours: str) -> None:
    scene = scenes[contours]
    exact = truth(scene, scene.size)
    assert exact.dtype == torch.float64
    assert (exact - truth(scene, scene.size, dense=True)).abs().max() < 1e-10


def test_opacities_are_drawn(tmp_path: Path) -> None:
    plain = GaussianField.random(20, (32, 48), regions=torch.zeros(32, 48).long(), seed=0)
    field = GaussianField(
        plain.means, plain.cholesky, plain.colors, plain.region_ids, torch.linspace(0, 1, 20), size=plain.size
    )
    scene = Scene("x", "made by rule", field, RegionMap.from_labels(torch.zeros(32, 48).long()))
    files, exact = write_files(tmp_path / "files", scene, 1e-4), truth(scene, (32, 48))
    for name in DECODERS:
        assert (open_decoder(name, files, (32, 48), 1)() - exact).abs().max() < 1e-3


def test_race_takes_turns() -> None:
    drawn: list[tuple[str, int]] = []

    def draw(name: str) -> torch.Tensor:
        drawn.append((name, torch.get_num_threads()))
        return torch.zeros(())

    draws = {Entrant(name, n, 1e-4): lambda name=name: draw(name) for name, n in (("a", 1), ("b", 2))}
    seconds = race(draws, 3)
    assert drawn == [("a", 1)] * 2 + [("b", 2)] * 2 + ([("a", 1)] * 2 + [("b", 2)] * 2) * 2
    assert [len(times) for times in seconds.values()] == [3, 3]
    assert ratio([2.0, 9.0, 4.0], [1.0, 1.0, 2.0]) == 2.0


def test_opening_and_memory(scenes: dict[str, Scene], tmp_path: Path) -> None:
    small = write_files(tmp_path / "small", scenes["hard"], 1e-4)
    took = opening(SCENE, small, (96, 128), 1)
    assert 0 < took.load < took.first
    count, size = 3_000, (600, 800)
    large = Scene("large", "made by rule", GaussianField.random(count, size, seed=0), None)
    files = write_files(tmp_path / "large", large, 1e-4)
    picture = 12 * size[0] * size[1] / 1e6
    ballast = torch.ones(60_000_000)  # a parent larger than the child must not hide the child's peak
    peak = peak_memory(TILED, files, size, small)
    del ballast
    assert math.isnan(peak) or picture < peak < 2_000


def test_fits_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "--data" in (why_not_fitted(None, False) or "") and fitted_scenes(tmp_path / "scenes", None, False) == []
    assert "DAVIS" in (why_not_fitted(tmp_path, False) or "")
    assert not (tmp_path / "scenes").exists()
    (first,) = fitted_scenes(tmp_path / "scenes", None, True)

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("fitted again")

    monkeypatch.setattr("kcgs.bench.decode.scenes.fit", refuse)
    (again,) = fitted_scenes(tmp_path / "scenes", None, True)
    assert again.source == first.source and torch.equal(again.field.means, first.field.means)
    monkeypatch.setattr("kcgs.bench.decode.scenes.QUICK_ITERATIONS", 21)
    with pytest.raises(AssertionError, match="fitted again"):
        fitted_scenes(tmp_path / "scenes", None, True)


def test_cutoffs_are_written_as_people_do() -> None:
    assert [cutoff_name(c) for c in (1e-2, 1 / 255, 1e-3, 1e-6)] == ["1e-2", "1/255", "1e-3", "1e-6"]


def test_quick_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # processes of their own are another test's
    monkeypatch.setattr("kcgs.bench.decode.experiment.peak_memory", _pretend)
    run("decode", tmp_path, quick=True)
    made = {"report.md", "results.csv", "error-against-time.png", "speed.png", "scenes"}
    assert {path.name for path in tmp_path.iterdir()} == made
    with (tmp_path / "results.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == list(Row._fields)
    assert list(dict.fromkeys(row["section"] for row in rows)) == ["memory", "files", "speed", "error", "truth"]
    for row in rows:
        assert math.isfinite(float(row["value"]))
        if row["quantity"] == "max error" and row["section"] == "speed":
            assert 0 < float(row["value"]) < 1e-3
    worst = {(r["scene"], r["decoder"], r["cutoff"]): float(r["value"]) for r in rows if r["quantity"] == "max error"}
    for name in (SCENE, CPU, TILED):
        errors = [worst["small hard", name, cutoff] for cutoff in ("0.01", "0.00392157", "0.001", "0.0001", "1e-06")]
        assert errors == sorted(errors, reverse=True) and errors[-1] < 1e-4
    report = (tmp_path / "report.md").read_text()
    for words in ("onnxruntime, generic", "small soft", "soft weights: contours are hard", "kcgs bench decode"):
        assert words in report
    # the long form's tables, from the same numbers
    kinds = {"threads": int, "cutoff": float, "value": float}
    numbers = [Row(**{key: kinds.get(key, str)(value) for key, value in row.items()}) for row in rows]
    (tmp_path / "long").mkdir()
    write(tmp_path / "long", Findings(numbers, standard_scenes(quick=True), {}, "no data", False))
    report = (tmp_path / "long" / "report.md").read_text()
    assert "goals" in report and "(met)" in report and "Without fitted scenes: no data." in report


def _pretend(name: str, files: Files, size: tuple[int, int], small: Files) -> float:
    return 1.0
