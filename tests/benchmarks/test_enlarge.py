"""The benchmark of enlarged scenes: its plan, its arithmetic, its files; the fits themselves are played by a stub."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import benchmarks
from benchmarks.core import images
from benchmarks.core import store as store_module
from benchmarks.core.cases import BEST, Case
from benchmarks.core.rows import read_rows
from benchmarks.core.store import Row, Store
from benchmarks.enlarge import FACTORS, METHODS, OWN, PHOTO, SCENE, chosen, compare, enlarge, gains_table, missing, plan
from kcgs.data import save_image
from kcgs.fitting import FitConfig, FitResult, HistoryEntry
from kcgs.functional import RegionMap, ef_psnr, psnr
from kcgs.nn import GaussianField
from kcgs.scene import Scene


class Stub:
    """Plays the fit: random Gaussians."""

    def __init__(self) -> None:
        self.asked: list[tuple[int, ...]] = []
        self.stop_at: int | None = None

    def __call__(self, image: Tensor, given: RegionMap | None, n: int, *, recipe: FitConfig, seed: int) -> FitResult:
        if len(self.asked) == self.stop_at:
            raise KeyboardInterrupt
        self.asked.append((*image.shape[1:], n))
        field = GaussianField.random(n, tuple(image.shape[1:]), sigma=8.0, seed=seed)
        if given is not None:
            field.assign_regions(given)
        return FitResult(Scene(field, given), [HistoryEntry(1, 0.1, 1.0, 10.0, 9.0, n)], "iterations", recipe)


@pytest.fixture
def stub(monkeypatch: pytest.MonkeyPatch) -> Stub:
    played = Stub()
    monkeypatch.setattr(store_module, "fit", played)
    monkeypatch.setattr(store_module, "warm_up", lambda config: None)
    return played


def make_data(folder: Path) -> Path:
    """Write a sequence and two photos, whose sides are no multiples of 4."""
    ramp = torch.linspace(0, 1, 86).expand(3, 50, 86)
    photo = torch.where(ramp > 0.4, 1 - 0.2 * ramp, 0.5 * ramp)
    for name in ("DAVIS/JPEGImages/480p/dog/00000.jpg", "kodak/kodim03.png", "kodak/kodim24.png"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        save_image(folder / name, photo)
    (folder / "DAVIS/Annotations/480p/dog").mkdir(parents=True)
    save_image(folder / "DAVIS/Annotations/480p/dog/00000.png", (ramp > 0.4).float())
    images.load.cache_clear()
    return folder


def row(image: str, method: str, value: float, n: int = 80) -> Row:
    figures = {"psnr": value, "ms_ssim": 0.9, "ef_psnr": value - 1, "ef_ssim": 0.8}
    decoded: dict[str, Any] = {f"decoded_{name}": math.nan for name in figures}
    return Row(
        image=image, n=n, method=method, seed=0, iterations=700, **figures, seconds=0.1, core_seconds=2.0,
        num_gaussians=n, pixels=26_400, bytes=100, map_bytes=10, **decoded, note="DAVIS, 4x",
    )  # fmt: skip


class TestSmallPhotos:
    def test_by_area_and_majority(self) -> None:
        image, labels = images.load("disc", None)
        small, few = images.load("disc", None, factor=4)
        assert labels is not None and few is not None
        assert small.shape == (3, 80, 100) and few.shape == (80, 100)
        assert torch.allclose(small[:, 9, 30], image[:, 36:40, 120:124].mean((1, 2)))
        block = labels[48:52, 176:180]
        assert few[12, 44] == block.flatten().mode().values

    def test_whole_blocks_of_the_middle(self) -> None:
        image, labels = torch.rand(3, 9, 14), torch.arange(14).expand(9, 14)
        cut = images.whole_blocks(images.Sample(image, labels), 4)
        assert torch.equal(cut.image, image[:, :8, 1:13])
        assert cut.labels is not None and cut.labels[0, 0] == 1

    @pytest.mark.parametrize("how", ["bicubic", "Lanczos"])
    def test_enlarging_keeps_centres(self, how: str) -> None:
        ramp = torch.linspace(0.2, 0.8, 30).expand(3, 20, 30)
        large = enlarge(ramp, (80, 120), how)
        positions = (torch.arange(120) + 0.5) / 4 - 0.5
        assert large.shape == (3, 80, 120)
        assert torch.allclose(large[0, 40, 16:-16], (0.2 + 0.6 * positions / 29)[16:-16], atol=1e-3)


class TestPlan:
    def test_images_that_are_there(self, tmp_path: Path) -> None:
        wanted = plan(make_data(tmp_path), False)
        assert [(c.image, c.source, c.factor, c.n) for c in wanted[:6]] == [
            ("dog", "given", factor, n) for factor, counts in ((4, (1, 3, 10)), (2, (3, 13, 43))) for n in counts
        ]
        assert [c.image for c in wanted[6:]] == 2 * (3 * ["kodim03"] + 3 * ["kodim24"])
        assert {c.source for c in wanted[6:]} == {"auto"}
        first, second = missing(wanted)
        assert first.startswith("DAVIS: 11 images are not in the data: blackswan, bmx-trees")
        assert second.startswith("Kodak: 22 images are not in the data: kodim01, kodim02, kodim04")
        assert len(plan(tmp_path, True)) == 2 * len(FACTORS)

    def test_no_data(self, tmp_path: Path) -> None:
        with pytest.raises(ValueError, match="data must name a folder with DAVIS in it"):
            plan(None, False)
        with pytest.raises(FileNotFoundError):
            plan(tmp_path, False)


class TestRows:
    def test_against_the_original(self, tmp_path: Path, stub: Stub) -> None:
        store, case = Store(tmp_path, None), Case("disc", 20, BEST, factor=4)
        store.make(case)
        image, labels = images.load("disc", None)
        assert labels is not None
        rows = {row.method: row for row in compare(store, case, 2)}
        assert tuple(rows) == METHODS and {row.note for row in rows.values()} == {"DAVIS, 4x"}
        scene, small = store.scene(case), images.load("disc", None, factor=4).image
        for method, shown in (
            (SCENE, scene.render((320, 400))),
            (OWN, enlarge(scene.render(), (320, 400), "bicubic")),
            (PHOTO, enlarge(small, (320, 400), "bicubic")),
        ):
            figures = [float(psnr(shown, image)), float(ef_psnr(shown, image, labels, width=20))]
            assert [rows[method].psnr, rows[method].ef_psnr] == figures
        assert math.isnan(rows[PHOTO].core_seconds) and rows[OWN].core_seconds == rows[SCENE].core_seconds > 0
        assert all(row.seconds > 0 for row in rows.values())

    def test_gains(self) -> None:
        rows = [row("a", SCENE, 30.2), row("a", OWN, 30.0), row("b", SCENE, 29.8), row("b", OWN, 30.0)]
        rows += [row("c", SCENE, 29.95), row("c", OWN, 30.0)]
        lines = gains_table({"DAVIS, 4x": rows}).splitlines()
        assert lines[2] == "| DAVIS, 4x | 80 | 330 | PSNR | 3 | -0.02 |  | b -0.20 | 1: b -0.20 |"
        assert lines[3].startswith("| DAVIS, 4x | 80 | 330 | EF-PSNR | 3 | -0.02 |")

    def test_crops_are_of_the_worst_and_of_the_middle(self) -> None:
        gains = {"a": 0.0, "b": -0.3, "c": 0.1, "d": -0.2, "e": 0.2, "f": 0.3, "g": 0.11, "h": -0.1}
        measured = {Case(name, 1, BEST): [row(name, SCENE, 30 + g), row(name, OWN, 30)] for name, g in gains.items()}
        measured[Case("b", 2, BEST)] = [row("b", SCENE, 29.9), row("b", OWN, 30)]
        assert [case.image for case in chosen(measured)] == ["b", "d", "h", "a", "c", "g"]
        assert chosen({}) == []


class TestFiles:
    def test_quick_without_data_resumes(self, tmp_path: Path, stub: Stub) -> None:
        benchmarks.run("enlarge", tmp_path, quick=True)
        names = {"results.csv", "made.json", "report.md", "runs", "crops.png", "error-against-time.png"}
        assert {path.name for path in tmp_path.iterdir()} == names
        assert stub.asked == [(80, 100, 24), (160, 200, 97), (128, 128, 50), (256, 256, 199)]
        rows = read_rows(tmp_path / "results.csv", Row)
        assert [row.method for row in rows] == 4 * [*METHODS]
        text = (tmp_path / "report.md").read_text()
        assert "python -m benchmarks enlarge -o DIR --quick" in text and "nan" not in text
        benchmarks.run("enlarge", tmp_path, redraw=True)
        assert (tmp_path / "report.md").read_text() == text
        benchmarks.run("enlarge", tmp_path, quick=True)
        assert len(stub.asked) == 4

    def test_interrupted(self, tmp_path: Path, stub: Stub) -> None:
        data = make_data(tmp_path / "data")
        stub.stop_at = 1
        with pytest.raises(KeyboardInterrupt):
            benchmarks.run("enlarge", tmp_path / "out", data=data)
        text = (tmp_path / "out/report.md").read_text()
        assert "- Stopped: 1 of 18 fits are there." in text and "- Kodak: 22 images are not in the data" in text

    def test_nothing_to_show(self, tmp_path: Path, stub: Stub) -> None:
        stub.stop_at = 0
        with pytest.raises(KeyboardInterrupt):
            benchmarks.run("enlarge", tmp_path, quick=True)
        assert "Stopped: 0 of 4 fits are there." in (tmp_path / "report.md").read_text()


@pytest.mark.slow
def test_quick_on_real_images(tmp_path: Path, data_root: Path) -> None:
    if not (data_root / "DAVIS").is_dir():
        pytest.skip(f"no DAVIS in {data_root}")
    benchmarks.run("enlarge", tmp_path, data=data_root, quick=True)
    rows = {row.method: row for row in read_rows(tmp_path / "results.csv", Row) if row.note == "DAVIS, 4x"}
    assert rows[PHOTO].psnr > rows[SCENE].psnr > 15 and rows[PHOTO].ef_psnr > rows[SCENE].ef_psnr
