"""The command line as a user or a script meets it."""

from __future__ import annotations

import json
import logging
import signal
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image

from kcgs import GaussianField, Scene, fit, load
from kcgs.cli import demo, main
from kcgs.cli.common import Stop
from kcgs.data import load_image, load_labels, save_image, save_labels
from kcgs.functional import psnr
from kcgs.segment import segment

KEYS = {
    *("psnr", "ssim", "ms_ssim", "ef_psnr", "ef_ssim"),
    *("num_gaussians", "regions", "seconds", "bytes", "bits_per_pixel"),
}


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    labels = torch.zeros(40, 60, dtype=torch.long)
    labels[10:30, 20:45] = 1
    image = torch.where(labels.bool(), torch.tensor([0.9, 0.4, 0.1])[:, None, None], 0.3)
    save_image("photo.png", image)
    save_labels("mask.png", labels)
    return tmp_path


def kcgs(*arguments: str, capsys: pytest.CaptureFixture[str]) -> tuple[int, str, str]:
    code = 0
    try:
        main_with(arguments)
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def main_with(arguments: tuple[str, ...]) -> None:
    before = sys.argv
    sys.argv = ["kcgs", *arguments]
    try:
        main()
    finally:
        sys.argv = before


FIT = ("fit", "photo.png", "-n", "12", "--iterations", "40", "-o", "scene.safetensors")


class TestFit:
    def test_kept_contours(self, files: Path, capsys: pytest.CaptureFixture[str]) -> None:
        code, out, err = kcgs(*FIT, "--regions", "mask.png", "--keep-contours", capsys=capsys)
        assert code == 0, err
        assert "\nregions: 2 of 2 regions kept\n" in out
        regions = load("scene.safetensors").regions
        assert regions is not None
        assert torch.equal(regions.labels, load_labels(Path("mask.png")))

    @pytest.mark.usefixtures("clock")
    def test_max_seconds(self, files: Path, capsys: pytest.CaptureFixture[str]) -> None:
        arguments = ("--regions", "none", "--iterations", "1000000", "--max-seconds", "4", "--json")
        code, out, err = kcgs(*FIT, *arguments, capsys=capsys)
        report = json.loads(out)
        assert (code, report["target_reached"], report["stop_reason"]) == (0, None, "seconds"), err

    def test_interrupt_saves_the_best_so_far(
        self, files: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def interrupted_step(stop: Stop, iteration: int, entry: Any) -> bool:
            if iteration == 3:
                signal.raise_signal(signal.SIGINT)
            return stop.wanted

        monkeypatch.setattr(Stop, "step", interrupted_step)
        code, out, err = kcgs(*FIT, "--regions", "mask.png", "--json", capsys=capsys)
        assert code == 130 and err == "kcgs: interrupted: saved the best so far to scene.safetensors\n"
        report = json.loads(out)
        assert 1 <= report["num_gaussians"] <= 12 and report["stop_reason"] == "interrupted"
        assert 1 <= load("scene.safetensors").num_gaussians <= 12

    def test_a_second_interrupt_ends_the_command(self) -> None:
        with Stop():
            signal.raise_signal(signal.SIGINT)
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)

    def test_target_psnr(self, files: Path, capsys: pytest.CaptureFixture[str]) -> None:
        arguments = ("--iterations", "300", "--target-psnr", "25", "-n", "500", "--regions", "mask.png", "--json")
        code, out, err = kcgs(*FIT, *arguments, capsys=capsys)
        assert code == 0, err
        report = json.loads(out)
        assert report["psnr"] >= 25 and report["target_reached"] is True and report["stop_reason"] == "target_psnr"
        assert report["num_gaussians"] < 100

    @pytest.mark.parametrize("suffix", ["safetensors", "kcgs"])
    def test_target_psnr_out_of_reach(self, files: Path, capsys: pytest.CaptureFixture[str], suffix: str) -> None:
        code, out, err = kcgs(
            *FIT[:-1], f"s.{suffix}", "--regions", "none", "--target-psnr", "90", "--json", capsys=capsys
        )
        report = json.loads(out)
        assert code == 1 and report["target_reached"] is False and report["stop_reason"] == "iterations"
        assert f"--target-psnr 90 was not reached: {report['psnr']:.2f} dB is the best\n" in err
        assert float(psnr(load(f"s.{suffix}").render(), load_image("photo.png"))) == pytest.approx(report["psnr"])

    def test_target_psnr_of_a_file(self, files: Path, capsys: pytest.CaptureFixture[str]) -> None:
        code, _, err = kcgs(*FIT[:-1], "photo.kcgs", "-n", "60", "--target-psnr", "24", capsys=capsys)
        assert code == 0, err
        assert float(psnr(load("photo.kcgs").render(), load_image("photo.png"))) >= 24

    @pytest.mark.filterwarnings("default")
    def test_warnings_are_lines_and_what_is_not_defined_is_no_number(
        self, files: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        Image.new("RGBA", (40, 30), (255, 0, 0, 9)).save("clear.png")
        code, out, err = kcgs(
            "fit", "clear.png", "-n", "5", "--iterations", "2", "-q", "--regions", "none", capsys=capsys
        )
        assert (code, err) == (0, "warning: clear.png has transparent pixels: they are composed on white\n")
        assert "nan" not in out and out.count("not defined") == 3

    @pytest.mark.parametrize("regions", ["mask.png", "auto", "none"])
    def test_fit_render_eval_info(self, files: Path, capsys: pytest.CaptureFixture[str], regions: str) -> None:
        code, out, err = kcgs(*FIT, "--regions", regions, "--json", capsys=capsys)
        assert code == 0, err
        report = json.loads(out)
        assert set(report) == KEYS | {"region_report", "stop_reason", "target_reached"}
        assert (report["region_report"] is None) == (regions == "none")
        assert report["stop_reason"] == "iterations" and report["target_reached"] is None
        assert 1 <= report["num_gaussians"] <= 12
        assert report["bytes"] == (files / "scene.safetensors").stat().st_size
        assert (report["ef_psnr"] is None) == (regions == "none")
        assert report["ms_ssim"] is None  # the image is too small for it

        code, out, _ = kcgs("eval", "scene.safetensors", "photo.png", "--json", capsys=capsys)
        assert code == 0
        again = json.loads(out)
        assert set(again) == KEYS | {"ssimulacra2"}
        assert again["psnr"] == pytest.approx(report["psnr"], abs=1e-4)

        code, out, _ = kcgs("info", "scene.safetensors", "--json", capsys=capsys)
        assert code == 0
        assert json.loads(out)["height"] == 40

        assert kcgs("render", "scene.safetensors", "-o", "large.png", "--scale", "2", capsys=capsys)[0] == 0
        assert load_image("large.png").shape == (3, 80, 120)

    def test_the_same_scene_as_in_python(self, files: Path, capsys: pytest.CaptureFixture[str]) -> None:
        image = load_image("photo.png")
        assert kcgs("fit", "photo.png", "-n", "12", "--iterations", "40", capsys=capsys)[0] == 0
        scene = load("photo.safetensors")
        result = fit(image, segment(image), 12, iterations=40)
        for name in ("means", "cholesky", "colors", "region_ids"):
            assert torch.equal(getattr(scene.field, name), getattr(result.scene.field, name)), name
        assert scene.regions is not None and result.scene.regions is not None
        assert torch.equal(scene.regions.labels, result.scene.regions.labels)

    def test_default_output_is_named_after_the_image(self, files: Path, capsys: pytest.CaptureFixture[str]) -> None:
        code, out, err = kcgs("fit", "photo.png", "-n", "3", "--iterations", "2", capsys=capsys)
        assert code == 0, err
        assert (files / "photo.safetensors").is_file()
        assert "psnr" in out

    def test_no_bar_off_a_terminal(self, files: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert kcgs(*FIT, "--json", capsys=capsys)[2] == ""

    @pytest.mark.parametrize("options", [["--json"], ["--quiet"], []])
    def test_hushed_about_what_it_compiles(
        self, options: list[str], files: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        kcgs("fit", "photo.png", "-n", "3", "--iterations", "2", *options, capsys=capsys)
        assert logging.getLogger("kcgs").isEnabledFor(logging.INFO) is not bool(options)

    def test_recipe_is_recorded(self, files: Path, capsys: pytest.CaptureFixture[str]) -> None:
        kcgs(*FIT, "--recipe", "gaussian-image", capsys=capsys)
        scene = load("scene.safetensors")
        assert scene.metadata["recipe"] == "gaussian-image"
        assert scene.regions is None


class TestRender:
    @pytest.fixture
    def scene(self, files: Path, capsys: pytest.CaptureFixture[str]) -> Path:
        assert kcgs(*FIT, "--regions", "mask.png", capsys=capsys)[0] == 0
        return files / "scene.safetensors"

    def test_size(self, scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert kcgs("render", str(scene), "-o", "a.png", "--size", "90x50", capsys=capsys)[0] == 0
        with Image.open("a.png") as render:
            assert render.size == (90, 50)

    def test_a_batch_is_refused_by_its_name(self, scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
        one = load(scene).field
        means, cholesky, colors = (torch.stack([t.detach(), t.detach()]) for t in one.parameters())
        Scene(GaussianField(means, cholesky, colors, size=one.size)).save("batch.safetensors")
        assert json.loads(kcgs("info", "batch.safetensors", "--json", capsys=capsys)[1])["images"] == 2
        for arguments in (("eval", "photo.png"), ("encode", "-o", "a.kcgs"), ("view",), ("export", "-o", "a.onnx")):
            code, _, err = kcgs(arguments[0], "batch.safetensors", *arguments[1:], capsys=capsys)
            assert code == 2 and "must be of one image; got a batch of 2: scene[t] is one of them" in err, err

    @pytest.mark.parametrize(
        ("arguments", "code", "words"),
        [
            (("--size", "90"), 2, "--size must be WxH"),
            (("--size", "0x5"), 2, "--size must be at least 1 x 1"),
            (("--scale", "-1"), 2, "--scale must be in (0, 1e+06]; got -1.0"),
            (("--scale", "2", "--size", "4x4"), 2, "--size excludes --scale"),
        ],
    )
    def test_wrong_usage(
        self, scene: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], code: int, words: str
    ) -> None:
        got, _, err = kcgs("render", str(scene), "-o", "a.png", *arguments, capsys=capsys)
        assert got == code
        assert words in " ".join(err.replace("│", " ").split())
        assert not Path("a.png").exists()


class TestSegment:
    def test_writes_a_label_map(self, files: Path, capsys: pytest.CaptureFixture[str]) -> None:
        code, out, _ = kcgs("segment", "photo.png", "-o", "labels.png", "--json", capsys=capsys)
        assert code == 0
        labels = load_labels("labels.png")
        assert labels.shape == (40, 60)
        assert json.loads(out)["regions"] == len(labels.unique())


class TestFailures:
    @pytest.mark.parametrize(
        ("arguments", "code", "words"),
        [
            ((), 2, "Usage"),
            (("fit",), 2, "Missing argument"),
            (("fit", "photo.png", "b.png"), 2, "extra argument(s) (b.png)"),
            (("fit", "photo.png", "-n", "0"), 2, "greater than or equal to 1"),
            (("fit", "photo.png", "--objective", "visual"), 2, "'visual' is not one of"),
            (("fit", "nothing.png"), 1, "nothing.png"),
            (("fit", "text.png"), 1, "text.png"),
            (("fit", "photo.png", "--recipe", "none-such"), 2, "--recipe must be one of"),
            (("fit", "photo.png", "--regions", "nothing.png"), 1, "No such file or directory: nothing.png"),
            (("fit", "photo.png", "--regions", "small.png"), 2, "--regions must be one map of the image's size"),
            (("fit", "photo.png", "-o", "scene.pt"), 2, "must end in .safetensors"),
            (("fit", "photo.png", "-o", "scene.KCGS"), 2, "must end in .safetensors"),
            (("fit", "photo.png", "-o", "nowhere/scene.safetensors"), 1, "needs an existing folder"),
            (("fit", "photo.png", "--max-seconds", "-1"), 2, "--max-seconds must be greater than 0; got -1.0"),
            (("fit", "photo.png", "--target-psnr", "-3"), 2, "--target-psnr must be greater than 0; got -3.0"),
            (("fit", "folder"), 2, "'IMAGE': file 'folder' is a directory"),
            (("info", "text.png"), 2, "'SCENE': it must end in .safetensors or .kcgs, or be zoo:NAME; got 'text.png'"),
            (("info", "nothing.kcgs"), 1, "kcgs: No such file or directory: nothing.kcgs"),
            (("decode", "nothing.kcgs", "-o", "a.png"), 1, "kcgs: No such file or directory: nothing.kcgs"),
            (("encode", "zoo:chart-pie", "-o", "a.kcgs", "--quality", "500"), 2, "--quality must be in [10, 90]"),
            (("segment", "photo.png", "-o", "a.png", "--method", "magic"), 2, "--method must be one of"),
        ],
    )
    def test_one_line_and_an_exit_code(
        self, files: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], code: int, words: str
    ) -> None:
        Path("text.png").write_text("this is no image")
        Path("folder").mkdir()
        save_labels("small.png", torch.zeros(4, 4, dtype=torch.long))
        before = sorted(p.name for p in files.iterdir())
        got, out, err = kcgs(*arguments, capsys=capsys)
        assert got == code
        assert words in " ".join((out + err).replace("│", " ").split())
        if code == 1 or err.startswith("kcgs: "):
            assert err.startswith("kcgs: ") and err.count("\n") == 1
        assert sorted(p.name for p in files.iterdir()) == before


def test_demo(
    tmp_path: Path, astronaut: torch.Tensor, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    small, make = torch.nn.functional.avg_pool2d(astronaut, 4), demo.run
    monkeypatch.setattr(demo, "run", lambda output, image, size, **_: make(output, small, 600, iterations=20))
    code, out, err = kcgs("demo", "-o", str(tmp_path / "demo"), capsys=capsys)
    assert code == 0, err
    written = {p.name for p in (tmp_path / "demo").iterdir()}
    assert {"original.png", "regions.png", "baseline.png", "contour-aware.png", "comparison.png"} <= written
    for name in ("baseline", "contour-aware"):
        assert (tmp_path / "demo" / f"{name}.kcgs").stat().st_size <= 600
    assert "contour-aware" in out and "EF-PSNR" in out
