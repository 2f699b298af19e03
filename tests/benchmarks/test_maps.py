"""The benchmark of automatic maps: its plan, its arithmetic, its files; the fits themselves are played by a stub."""

from __future__ import annotations

import csv
import math
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import benchmarks
from benchmarks.core import store as store_module
from benchmarks.core.report import Made, conclude
from benchmarks.core.rows import write_rows
from benchmarks.core.store import Store
from benchmarks.maps import (
    AUTO,
    COUNTS,
    OTHERS,
    Result,
    baseline,
    compare,
    equal_bytes,
    failures,
    gain_of,
    images_of,
    plan,
    report,
)  # fmt: skip
from kcgs.cli import main
from kcgs.codec import decode, encode
from kcgs.data import load_image, save_image
from kcgs.fitting import FitConfig, FitResult, HistoryEntry
from kcgs.functional import RegionMap, ef_psnr, psnr
from kcgs.nn import GaussianField
from kcgs.scene import Scene


class Stub:
    """Plays the fit: random Gaussians, and contours that moved to the middle."""

    def __init__(self) -> None:
        self.asked: list[tuple[int, bool]] = []
        self.stop_at: int | None = None
        self.keeps_contours = True

    def __call__(self, image: Tensor, given: RegionMap | None, n: int, *, recipe: FitConfig, seed: int) -> FitResult:
        if len(self.asked) == self.stop_at:
            raise KeyboardInterrupt
        self.asked.append((n, given is not None))
        assert recipe.guidance == (given is not None)
        field = GaussianField.random(n, tuple(image.shape[1:]), sigma=8.0, seed=seed)
        regions = None
        if given is not None:
            halves = torch.arange(image.shape[2]) >= image.shape[2] // 2
            regions = RegionMap.from_labels((halves & self.keeps_contours).long().expand(image.shape[1:]).contiguous())
            field.assign_regions(regions)
        history = [HistoryEntry(1, 0.1, 1.0, 10.0, 9.0, n)]
        return FitResult(Scene(field, regions), history, "iterations", recipe)


@pytest.fixture
def stub(monkeypatch: pytest.MonkeyPatch) -> Stub:
    played = Stub()
    monkeypatch.setattr(store_module, "fit", played)
    monkeypatch.setattr(store_module, "warm_up", lambda config: None)
    return played


@pytest.fixture
def data(tmp_path: Path) -> Iterator[Path]:
    """Make three small images."""
    ramp = torch.linspace(0, 1, 120).expand(3, 80, 120)
    for name in ("12", "7", "103"):
        (tmp_path / "data/bsds" / name).mkdir(parents=True)
        save_image(tmp_path / f"data/bsds/{name}/image.jpg", torch.where(ramp > 0.4, 1 - 0.2 * ramp, 0.5 * ramp))
    yield tmp_path / "data"
    benchmarks.core.images.load.cache_clear()


def row(image: str = "7", n: int = 400, gain: float = 0.5, ef_gain: float = 1.0, **values: Any) -> Result:
    ours = 30.0, 25.0, 30.0 - gain, 25.0 - ef_gain, 0.5, 8.0, 4.0
    fixed = Result(image, n, AUTO, 4, 3, 2400, 200, *ours, 29.75, 24.75, 500, 2410, 30.0, 24.25)
    return fixed._replace(**values)


def encode_like_reports(scene: Scene, quality: float) -> bytes:
    return encode(scene, quality=quality + 14.5)


def section(text: str, title: str) -> str:
    return text.split(f"# {title}\n\n")[1].split("\n\n#")[0]


class TestPlan:
    def test_images(self, data: Path) -> None:
        assert images_of(data) == ["7", "12", "103"] and images_of(None) == ["astronaut"]
        with pytest.raises(ValueError, match=r"data must have a folder bsds with NAME/image.jpg in it; got .*bsds'"):
            images_of(data / "bsds")

    def test_cases(self, data: Path) -> None:
        full = plan(data, False)
        assert [(c.n, c.image) for c in full if c.source == AUTO] == [(n, i) for n in COUNTS for i in images_of(data)]
        assert [(c.n, c.image, c.source) for c in full if c.source != AUTO] == [(400, "7", s) for s in OTHERS]
        assert len(plan(data, True)) == 2 + len(OTHERS)

    def test_settings_are_those_of_the_command(
        self, data: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        taken: dict[str, Any] = {}

        def refuse(image: Tensor, labels: Tensor, n: int, **options: Any) -> None:
            taken.update(options)
            raise ValueError("that is all")

        monkeypatch.setattr(import_module("kcgs.fitting"), "fit", refuse)  # kcgs.fit is the function too
        photo = str(data / "bsds/7/image.jpg")
        monkeypatch.setattr(
            sys, "argv", ["kcgs", "fit", photo, "--recipe", "best-refined", "-o", str(data / "scene.safetensors")]
        )
        with pytest.raises(SystemExit):
            main()
        assert "that is all" in capsys.readouterr().err
        case = plan(data, False)[0]
        asked = taken.get("recipe", taken.get("config"))
        assert case.config() == (asked if isinstance(asked, FitConfig) else FitConfig.from_recipe(asked))
        assert baseline(case).config() == FitConfig.from_recipe("best-baseline")


class TestResult:
    def test_both_are_measured_in_the_final_band(self, tmp_path: Path, data: Path, stub: Stub) -> None:
        store, case = Store(tmp_path / "runs", data), plan(data, False)[0]._replace(n=30)
        assert compare(store, case) is None
        store.make(case)
        assert compare(store, case) is None  # not without its baseline
        store.make(baseline(case))
        found = compare(store, case)
        assert found is not None and found.equal_n == 0 and math.isnan(found.equal_psnr)
        image = load_image(data / "bsds/7/image.jpg")
        ours, other = store.scene(case), store.scene(baseline(case))
        assert ours.regions is not None and other.regions is None
        final = ours.regions.labels
        assert final[0, 59] != final[0, 60]  # where the stub puts it, not where it was found
        assert 0 < found.map_bytes < found.bytes and found.regions == 2
        renders = [ours.render(), other.render()]
        assert [found.psnr, found.baseline_psnr] == [float(psnr(p, image)) for p in renders]
        assert [found.ef_psnr, found.baseline_ef_psnr] == [float(ef_psnr(p, image, final)) for p in renders]

        file, alone = encode_like_reports(ours, found.psnr), encode_like_reports(other, found.baseline_psnr)
        assert len(file) == found.bytes
        rival = equal_bytes(store, case)
        assert rival == baseline(case)._replace(n=round(30 * len(file) / len(alone))) and rival.n > 30
        assert equal_bytes(store, case._replace(source="slic")) is None
        store.make(rival)
        found = compare(store, case)
        assert found is not None and found.equal_n == rival.n and math.isfinite(found.equal_ef_psnr)
        decoded, third = decode(file), store.scene(rival)
        assert found.decoded_psnr == float(psnr(decoded.scene.render(), image))
        assert found.equal_bytes == len(encode_like_reports(third, float(psnr(third.render(), image))))

    def test_without_a_contour(self, tmp_path: Path, data: Path, stub: Stub) -> None:
        stub.keeps_contours = False
        benchmarks.run("maps", tmp_path / "out", data=data, quick=True)
        text = (tmp_path / "out/report.md").read_text()
        assert "auto, N = 60: no contour is left on 7, 12" in text and "nan" not in text


class TestGains:
    def test_gain(self) -> None:
        gain = gain_of([row("a", gain=0.5), row("b", gain=-0.25), row("c", gain=0.003)], "PSNR")
        assert gain is not None and gain.mean == pytest.approx(0.253 / 3)
        assert (gain.wins, gain.losses, gain.worst[0], gain.values["b"]) == (1, 1, "b", -0.25)
        assert gain_of([row(ef_psnr=math.nan)], "EF-PSNR") is None


class TestReport:
    def test_failures_come_first(self, tmp_path: Path) -> None:
        results = [row("a"), row("b", gain=-0.2), row("a", gain=-0.01, source="slic")]
        write_rows(tmp_path / "results.csv", Result, results)
        conclude(report, tmp_path, Made("python -m benchmarks maps"))
        text = (tmp_path / "report.md").read_text()
        assert section(text, "Where a map does not help").splitlines() == [
            "- auto, N = 400, PSNR: 1 of 2 images lose: b -0.20",
            "- auto, N = 400, PSNR at equal bytes: 2 of 2 images lose: a -0.25, b -0.25",
            "- slic, N = 400, PSNR: 1 of 1 images lose: a -0.01",
            "- slic, N = 400, PSNR at equal bytes: 1 of 1 images lose: a -0.25",
        ]
        assert "| 400 | auto | PSNR | 2 | +0.15 |" in text and "| 1-1 | b -0.20 |" in text
        assert "| 400 | slic | 3 | 2,400 | 200 | 500 | 0.5 | 8 | 4 |" in text

    def test_nothing_lost(self) -> None:
        assert failures([row(equal_psnr=29.0)]) == "Nowhere."

    def test_nothing_to_show(self, tmp_path: Path) -> None:
        conclude(report, tmp_path, Made("python -m benchmarks maps"))
        assert {p.name for p in tmp_path.iterdir()} == {"report.md", "made.json"}


class TestFiles:
    def test_quick_without_data_resumes(self, tmp_path: Path, stub: Stub) -> None:
        benchmarks.run("maps", tmp_path, quick=True)
        assert {p.name for p in tmp_path.iterdir()} == {"results.csv", "made.json", "report.md", "runs"}
        # a baseline, a map of each source, a baseline at equal bytes
        count = len(stub.asked)
        assert count == len(list((tmp_path / "runs").glob("*.safetensors"))) == 1 + 5 + 1
        with (tmp_path / "results.csv").open() as file:
            lines = list(csv.DictReader(file))
        assert [line["source"] for line in lines] == [AUTO, *OTHERS]
        text = (tmp_path / "report.md").read_text()
        assert "python -m benchmarks maps -o DIR --quick" in text and "nan" not in text
        benchmarks.run("maps", tmp_path, quick=True)
        assert len(stub.asked) == count

    def test_interrupted(self, tmp_path: Path, data: Path, stub: Stub) -> None:
        stub.stop_at = 3
        with pytest.raises(KeyboardInterrupt):
            benchmarks.run("maps", tmp_path / "out", data=data, quick=True)
        assert "Stopped before its end: 1 of 6 fits" in (tmp_path / "out/report.md").read_text()
        stub.stop_at = None
        benchmarks.run("maps", tmp_path / "out", data=data, quick=True)
        assert len(stub.asked) == 3 + 3 + len(OTHERS)
        assert "Stopped" not in (tmp_path / "out/report.md").read_text()


@pytest.mark.slow
def test_quick_on_real_images(tmp_path: Path, data_root: Path) -> None:
    if not (data_root / "bsds").is_dir():
        pytest.skip(f"no bsds in {data_root}")
    benchmarks.run("maps", tmp_path, data=data_root, quick=True)
    with (tmp_path / "results.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 6 and all(float(line["psnr"]) > float(line["baseline_psnr"]) for line in lines)
