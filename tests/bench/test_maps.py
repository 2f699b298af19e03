"""The benchmark of automatic maps: its plan, its arithmetic, its files; the fits themselves are played by a stub."""

from __future__ import annotations

import csv
import math
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import kcgs.bench
from kcgs.bench.maps import report, trials
from kcgs.bench.maps.experiment import run
from kcgs.bench.maps.gains import bounds, gain_of, interval
from kcgs.bench.maps.trials import AUTO, COUNTS, NO_MAP, OTHERS, Result, Scenes, Trial, images_of, plan, subset
from kcgs.cli import main
from kcgs.codec import decode, encode
from kcgs.data import load_image, save_image
from kcgs.fit import FitConfig, FitResult, HistoryEntry
from kcgs.functional import RegionMap, ef_psnr, psnr
from kcgs.io import Scene, load
from kcgs.nn import GaussianField
from kcgs.nn.renderer import render_image


class Stub:
    """Plays kcgs.fit.fit: random Gaussians, and contours that moved to the middle."""

    def __init__(self) -> None:
        self.asked: list[tuple[int, bool]] = []
        self.stop_at: int | None = None
        self.keeps_contours = True

    def __call__(self, image: Tensor, labels: Tensor | None, n: int, *, config: FitConfig, seed: int) -> FitResult:
        if len(self.asked) == self.stop_at:
            raise KeyboardInterrupt
        self.asked.append((n, labels is not None))
        assert config.guidance == (labels is not None)
        field = GaussianField.random(n, tuple(image.shape[1:]), sigma=8.0, seed=seed)
        regions = None
        if labels is not None:
            halves = torch.arange(image.shape[2]) >= image.shape[2] // 2
            regions = RegionMap.from_labels((halves & self.keeps_contours).long().expand(image.shape[1:]).contiguous())
            field.assign_regions(regions)
        return FitResult(Scene(field, regions), [HistoryEntry(1, 0.1, 1.0, 10.0, 9.0, n)], "iterations", config)


@pytest.fixture
def stub(monkeypatch: pytest.MonkeyPatch) -> Stub:
    played = Stub()
    monkeypatch.setattr(trials, "fit", played)
    monkeypatch.setattr(trials, "warm_up", lambda config: None)
    return played


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """Make three small pictures."""
    ramp = torch.linspace(0, 1, 120).expand(3, 80, 120)
    for name in ("12", "7", "103"):
        (tmp_path / "data/bsds" / name).mkdir(parents=True)
        save_image(tmp_path / f"data/bsds/{name}/image.jpg", torch.where(ramp > 0.4, 1 - 0.2 * ramp, 0.5 * ramp))
    return tmp_path / "data"


def row(image: str = "7", n: int = 400, gain: float = 0.5, ef_gain: float = 1.0, **values: Any) -> Result:
    ours = 30.0, 25.0, 30.0 - gain, 25.0 - ef_gain, 0.5, 8.0, 4.0
    fixed = Result(image, n, AUTO, 4, 3, 2400, 200, *ours, 29.75, 24.75, 500, 2410, 30.0, 24.25)
    return fixed._replace(**values)


def encode_like_reports(scene: Scene, quality: float) -> bytes:
    return encode(scene.field, scene.regions, quality=quality + 14.5)


def section(text: str, title: str) -> str:
    return text.split(f"# {title}\n\n")[1].split("\n\n#")[0]


class TestPlan:
    def test_pictures(self, data: Path) -> None:
        assert images_of(data) == ["7", "12", "103"] and images_of(None) == ["astronaut"]
        with pytest.raises(ValueError, match=r"data must have a folder bsds with NAME/image.jpg in it; got .*bsds'"):
            images_of(data / "bsds")

    def test_trials(self, data: Path) -> None:
        full = plan(data, False)
        assert [(t.n, t.image) for t in full if t.source == AUTO] == [(n, i) for n in COUNTS for i in images_of(data)]
        assert [(t.n, t.image, t.source) for t in full if t.source != AUTO] == [(400, "7", s) for s in OTHERS]
        assert len(plan(data, True)) == 2 + len(OTHERS)
        assert len(subset([str(i) for i in range(21)], False)) == 6

    def test_settings_are_those_of_the_command(
        self, data: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        taken: dict[str, Any] = {}

        def refuse(image: Tensor, labels: Tensor, n: int, **options: Any) -> None:
            taken.update(options)
            raise ValueError("that is all")

        monkeypatch.setattr(import_module("kcgs.fit"), "fit", refuse)  # kcgs.fit is the function too
        photo = str(data / "bsds/7/image.jpg")
        monkeypatch.setattr(sys, "argv", ["kcgs", "fit", photo, "-o", str(data / "scene.safetensors")])
        with pytest.raises(SystemExit):
            main()
        assert "that is all" in capsys.readouterr().err
        assert Trial("7", 400, AUTO).case().config() == taken["config"]
        assert Trial("7", 400, NO_MAP).case().config() == FitConfig.from_recipe("best-baseline")

    def test_settings_name_the_scene(self, tmp_path: Path) -> None:
        scenes, trial = Scenes(tmp_path / "runs", None), Trial("7", 400, AUTO)
        others = [trial._replace(n=401), trial._replace(source="slic"), trial._replace(quick=True), trial.baseline()]
        assert len({scenes._path(t) for t in [trial, *others]}) == 5


class TestResult:
    def test_both_are_measured_in_the_final_band(self, tmp_path: Path, data: Path, stub: Stub) -> None:
        scenes, trial = Scenes(tmp_path / "runs", data), Trial("7", 30, AUTO)
        assert scenes.result(trial) is None
        scenes.make(trial)
        assert scenes.result(trial) is None  # not without its baseline
        scenes.make(trial.baseline())
        found = scenes.result(trial)
        assert found is not None and found.equal_n == 0 and math.isnan(found.equal_gain)
        image = load_image(data / "bsds/7/image.jpg")
        ours, other = load(scenes._path(trial)), load(scenes._path(trial.baseline()))
        assert ours.regions is not None and other.regions is None
        final = ours.regions.labels
        assert final[0, 59] != final[0, 60]  # where the stub puts it, not where it was found
        assert 0 < found.map_bytes < found.bytes and found.regions == 2
        pictures = [render_image(ours.field, ours.regions), render_image(other.field)]
        assert [found.psnr, found.baseline_psnr] == [float(psnr(p, image)) for p in pictures]
        assert [found.ef_psnr, found.baseline_ef_psnr] == [float(ef_psnr(p, image, final)) for p in pictures]

        held, alone = encode_like_reports(ours, found.psnr), encode_like_reports(other, found.baseline_psnr)
        assert len(held) == found.bytes
        rival = scenes.equal_bytes(trial)
        assert rival == Trial("7", round(30 * len(held) / len(alone)), NO_MAP) and rival.n > 30
        assert scenes.equal_bytes(trial._replace(source="slic")) is None
        scenes.make(rival)
        found = scenes.result(trial)
        assert found is not None and found.equal_n == rival.n and math.isfinite(found.equal_ef_gain)
        decoded, third = decode(held), load(scenes._path(rival))
        assert found.decoded_psnr == float(psnr(render_image(decoded.field, decoded.regions), image))
        assert found.equal_bytes == len(encode_like_reports(third, float(psnr(render_image(third.field), image))))

    def test_without_a_contour(self, tmp_path: Path, data: Path, stub: Stub) -> None:
        stub.keeps_contours = False
        run(tmp_path / "out", data=data, quick=True)
        text = (tmp_path / "out/report.md").read_text()
        assert "auto, N = 60: no contour is left on 7, 12" in text and "nan" not in text


class TestGains:
    def test_interval(self) -> None:
        values = [0.1, 0.2, 0.3, 0.9]
        low, high = interval(values)
        assert -0.3 < low < 0.1 and 0.9 < high < 1.1  # Student's is -0.19 to 0.94; the values are skew
        assert interval(values) == (low, high) and interval([0.3]) == pytest.approx((0.3, 0.3))

    def test_gain(self) -> None:
        gain = gain_of([row("a", gain=0.5), row("b", gain=-0.25), row("c", gain=0.003)], "gain")
        assert gain is not None and gain.mean == pytest.approx(0.253 / 3)
        assert (gain.wins, gain.losses, gain.worst, gain.least) == (1, 1, "b", -0.25)
        assert gain_of([row(ef_psnr=math.nan)], "ef_gain") is None

    def test_bounds(self) -> None:
        found = bounds([row("a"), row("b", gain=0.35), row("a", 1_000, 0.5, 0.2), row("b", 1_000, -0.11, 0.2)])
        assert [b.met for b in found] == [True, True, True, True, False, False]
        assert found[-1].what == "N = 1,000: PSNR gained on the worst image (b), at least"
        assert bounds([row(n=60)]) == []


class TestReport:
    def test_failures_come_first(self, tmp_path: Path) -> None:
        results = [row("a"), row("b", gain=-0.2), row("a", gain=-0.01, source="slic")]
        report.write(tmp_path, results, planned=4, quick=False)
        text = (tmp_path / "report.md").read_text()
        assert "Stopped before its end: 3 of 4 fits" in text
        assert section(text, "Where a map does not help").splitlines() == [
            "- auto, N = 400, PSNR: 1 of 2 images lose: b -0.20",
            "- auto, N = 400, PSNR at equal bytes: 2 of 2 images lose: a -0.25, b -0.25",
            "- slic, N = 400, PSNR: 1 of 1 images lose: a -0.01",
            "- slic, N = 400, PSNR at equal bytes: 1 of 1 images lose: a -0.25",
        ]
        assert "| N = 400: mean PSNR gained, at least | +0.40 | +0.15 | NO |" in section(text, "Bounds")
        each = section(text, "Each image: auto, N = 400").splitlines()
        assert each[2].startswith("| b | auto | 4 | 3 | 2,400 | 200 | 30.00 | 30.20 | -0.20 |")
        assert each[2].endswith("| 500 | -0.25 | +0.50 |") and each[3].startswith("| a |")

    def test_nothing_lost(self) -> None:
        assert report.failures([row(equal_psnr=29.0)]) == "Nowhere."

    def test_nothing_to_show(self, tmp_path: Path) -> None:
        report.write(tmp_path, [], planned=3, quick=False)
        assert [p.name for p in tmp_path.iterdir()] == ["report.md"]


class TestFiles:
    def test_quick_without_data_resumes(self, tmp_path: Path, stub: Stub) -> None:
        kcgs.bench.run("maps", tmp_path, quick=True)
        assert {p.name for p in tmp_path.iterdir()} == {"results.csv", "report.md", "gains.png", "runs"}
        # a baseline, a map of each source, a baseline at equal bytes
        count = len(stub.asked)
        assert count == len(list((tmp_path / "runs").iterdir())) == 1 + 5 + 1
        with (tmp_path / "results.csv").open() as file:
            lines = list(csv.DictReader(file))
        assert [line["source"] for line in lines] == [AUTO, *OTHERS]
        assert all(
            float(line["gain"]) == pytest.approx(float(line["psnr"]) - float(line["baseline_psnr"]), abs=1e-3)
            for line in lines
        )
        text = (tmp_path / "report.md").read_text()
        assert "kcgs bench maps --quick" in text and "## Bounds" not in text and "nan" not in text
        run(tmp_path, quick=True)
        assert len(stub.asked) == count

    def test_interrupted(self, tmp_path: Path, data: Path, stub: Stub) -> None:
        stub.stop_at = 3
        with pytest.raises(KeyboardInterrupt):
            run(tmp_path / "out", data=data, quick=True)
        assert "Stopped before its end: 1 of 6 fits" in (tmp_path / "out/report.md").read_text()
        stub.stop_at = None
        run(tmp_path / "out", data=data, quick=True)
        assert len(stub.asked) == 3 + 3 + len(OTHERS)
        assert "Stopped" not in (tmp_path / "out/report.md").read_text()


@pytest.mark.slow
def test_quick_on_real_images(tmp_path: Path, data_root: Path) -> None:
    if not (data_root / "bsds").is_dir():
        pytest.skip(f"no bsds in {data_root}")
    run(tmp_path, data=data_root, quick=True)
    with (tmp_path / "results.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 6 and all(float(line["gain"]) > 0 for line in lines)
