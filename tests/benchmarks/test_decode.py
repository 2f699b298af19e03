"""The benchmark of the decoders in its quick form, and its parts."""

from __future__ import annotations

import copy
import csv
import json
import math
from functools import partial
from pathlib import Path

import pytest
import torch

from benchmarks import _decoders, run
from benchmarks._decoders import (
    CPU,
    CPU_DIRECT,
    DECODERS,
    GENERIC,
    SCENE,
    SCENE_DIRECT,
    TILED,
    Entrant,
    Subject,
    decoders_of,
    fitted_subjects,
    load_seconds,
    open_and_render,
    race,
    standard_subjects,
    truth,
    why_not_fitted,
    write_files,
    zoo_subjects,
)
from benchmarks._render_runs import renderer
from benchmarks.core.clocks import median_ratio, peak_bytes
from benchmarks.core.options import Options
from benchmarks.decode import Row, cutoff_name
from kcgs import GaussianField, RegionSplatRenderer
from kcgs.scene import Scene


@pytest.fixture(scope="module")
def subjects() -> dict[str, Subject]:
    return {subject.contours: subject for subject in standard_subjects(quick=True)}


def test_standard_subjects(subjects: dict[str, Subject]) -> None:
    assert list(subjects) == ["none", "hard", "soft"]
    assert [GENERIC in decoders_of(subject.scene) for subject in subjects.values()] == [True, True, False]
    full = standard_subjects(quick=False)
    assert [subject.name for subject in full] == [f"{w} {c}" for w in ("W1", "W2") for c in ("none", "hard", "soft")]
    assert {subject.scene.size for subject in full} == {(480, 854)}
    assert {subject.scene.num_gaussians for subject in full} == {1_250, 7_500}
    assert full[1].scene.regions is not None and full[1].scene.regions.num_regions == 6


@pytest.mark.parametrize("contours", ["none", "hard", "soft"])
@pytest.mark.parametrize("factor", [1, 2])
def test_all_render_the_same_image(subjects: dict[str, Subject], tmp_path: Path, contours: str, factor: int) -> None:
    scene = subjects[contours].scene
    size = (factor * scene.size[0], factor * scene.size[1])
    files = write_files(tmp_path / "files", scene, 1e-6)
    with torch.no_grad():
        want = RegionSplatRenderer(cutoff=1e-6)(scene.field, scene.regions, size)
    assert (truth(scene, size) - want).abs().max() < 2e-5
    assert want.std() > 0.05
    for name in decoders_of(scene):
        image = open_and_render(name, files, size)
        assert image.shape == want.shape
        assert (image - want).abs().max() < 1e-4, name


@pytest.mark.parametrize("contours", ["none", "hard", "soft"])
def test_truth_is_that_of_the_reference(subjects: dict[str, Subject], contours: str) -> None:
    scene = subjects[contours].scene
    exact = truth(scene, scene.size)
    assert exact.dtype == torch.float64
    dense = renderer("reference")(copy.deepcopy(scene).double(), 0.0)
    assert (exact - dense).abs().max() < 1e-10


def test_opacities_are_rendered(tmp_path: Path) -> None:
    plain = GaussianField.random(20, (32, 48), regions=torch.zeros(32, 48).long(), seed=0)
    field = GaussianField(
        plain.means, plain.cholesky, plain.colors, plain.region_ids, torch.linspace(0, 1, 20), size=plain.size
    )
    scene = Scene(field, torch.zeros(32, 48).long())
    files, exact = write_files(tmp_path / "files", scene, 1e-4), truth(scene, (32, 48))
    for name in DECODERS:
        assert (open_and_render(name, files, (32, 48)) - exact).abs().max() < 1e-3


def test_scenes_of_the_zoo_at_every_size() -> None:
    found = zoo_subjects()
    assert len(found) == 6 and all(subject.is_fitted for subject in found)
    assert [subject.contours for subject in found] == ["soft", "hard"] * 3
    assert [subject.is_typical for subject in found] == [True, False] * 3
    soft, hard = found[0].scene, found[1].scene
    assert decoders_of(soft) == [SCENE, SCENE_DIRECT, CPU, CPU_DIRECT, TILED] and decoders_of(hard) == list(DECODERS)
    assert decoders_of(hard, "3840 wide") == [SCENE, SCENE_DIRECT, CPU, CPU_DIRECT]


def test_race_takes_turns() -> None:
    rendered: list[tuple[str, int]] = []

    def render(name: str) -> torch.Tensor:
        rendered.append((name, torch.get_num_threads()))
        return torch.zeros(())

    renders = {Entrant(name, n, 1e-4): lambda name=name: render(name) for name, n in (("a", 1), ("b", 2))}
    seconds = race(renders, 3)
    assert rendered == ([("a", 1)] * 2 + [("b", 2)] * 2) * 3
    assert [len(times) for times in seconds.values()] == [3, 3]
    assert median_ratio([2.0, 9.0, 4.0], [1.0, 1.0, 2.0]) == 2.0


def test_loading_and_memory(subjects: dict[str, Subject], tmp_path: Path) -> None:
    small = write_files(tmp_path / "small", subjects["hard"].scene, 1e-4)
    assert load_seconds(SCENE, small, (96, 128), 1) > 0
    count, size = 3_000, (600, 800)
    files = write_files(tmp_path / "large", Scene(GaussianField.random(count, size, seed=0)), 1e-4)
    image = 12 * size[0] * size[1]
    ballast = torch.ones(60_000_000)  # a parent larger than the child must not hide the child's peak
    job, warm_up = (open_and_render, TILED, files, size), (open_and_render, TILED, small, (48, 64))
    peak = peak_bytes(partial, job, warm_up)
    del ballast
    assert math.isnan(peak) or image < peak < 2e9


def test_fits_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "--data" in (why_not_fitted(Options()) or "") and fitted_subjects(tmp_path, Options()) == []
    assert "DAVIS" in (why_not_fitted(Options(data=tmp_path)) or "")
    assert not list(tmp_path.iterdir())
    (first,) = fitted_subjects(tmp_path, Options(quick=True))

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("fitted again")

    monkeypatch.setattr("benchmarks.core.store.fit", refuse)
    (again,) = fitted_subjects(tmp_path, Options(quick=True))
    assert again.source == first.source and torch.equal(again.scene.field.means, first.scene.field.means)
    monkeypatch.setattr(_decoders, "QUICK_ITERATIONS", 19)
    with pytest.raises(RuntimeError, match="fitted again"):
        fitted_subjects(tmp_path, Options(quick=True))


def test_cutoffs_are_written_as_people_do() -> None:
    assert [cutoff_name(c) for c in (1e-2, 1 / 255, 1e-3, 1e-6)] == ["1e-2", "1/255", "1e-3", "1e-6"]


def test_quick_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # processes of their own are another test's
    monkeypatch.setattr("benchmarks.decode.peak_bytes", lambda *_: 1e6)
    run("decode", tmp_path, quick=True)
    made = {"report.md", "results.csv", "error-against-time.png", "made.json", "runs"}
    assert {path.name for path in tmp_path.iterdir()} == made
    with (tmp_path / "results.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == list(Row._fields)
    sections = ["memory", "files", "load", "speed", "error"]
    assert list(dict.fromkeys(row["section"] for row in rows)) == sections
    for row in rows:
        assert math.isfinite(float(row["value"]))
        if row["quantity"] == "max error" and row["section"] == "speed":
            assert 0 < float(row["value"]) < 1e-3
    worst = {(r["scene"], r["decoder"], r["cutoff"]): float(r["value"]) for r in rows if r["quantity"] == "max error"}
    for name in (SCENE, SCENE_DIRECT, CPU, CPU_DIRECT, TILED):
        errors = [worst["small hard", name, cutoff] for cutoff in ("0.01", "0.00392157", "0.001", "0.0001", "1e-06")]
        assert errors == sorted(errors, reverse=True) and errors[-1] < 1e-4
    report = (tmp_path / "report.md").read_text()
    for words in ("onnxruntime, generic", "small soft", "regions: 6, contours: soft", "python -m benchmarks decode"):
        assert words in report
    # written again from the same numbers
    about = json.loads((tmp_path / "made.json").read_text())
    (tmp_path / "made.json").write_text(json.dumps({**about, "notes": ["Without fitted scenes."]}))
    run("decode", tmp_path, redraw=True)
    again = (tmp_path / "report.md").read_text()
    assert "Without fitted scenes." in again
    assert again.partition("## Speed")[2] == report.partition("## Speed")[2]
