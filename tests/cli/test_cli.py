"""fit, eval, info, render and demo; wrong usage and failures of all commands."""

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
from kcgs.cli import demo
from kcgs.cli.common import InterruptHandler
from kcgs.data import load_image, load_labels, save_image, save_labels
from kcgs.functional import METRICS, psnr
from kcgs.segment import segment
from tests.cli.conftest import Kcgs
from tests.rate.conftest import min_sigma

KEYS = METRICS.keys() - {"ssimulacra2"} | {"num_gaussians", "regions", "seconds", "bytes", "bits_per_pixel"}
FIT = ("fit", "photo.png", "-n", "12", "--iterations", "20", "-o", "scene.safetensors")


@pytest.mark.usefixtures("photo")
class TestFit:
    @pytest.mark.parametrize("regions", ["mask.png", "none"])
    def test_reports(self, kcgs: Kcgs, regions: str) -> None:
        code, out, err = kcgs(*FIT, "--regions", regions, "--json")
        assert (code, err) == (0, "")
        report = json.loads(out)
        assert set(report) >= KEYS | {"region_report", "stop_reason", "target_reached"}
        assert (report["stop_reason"], report["target_reached"]) == ("iterations", None)
        assert 1 <= report["num_gaussians"] <= 12
        assert report["bytes"] == Path("scene.safetensors").stat().st_size
        # one region has no contours, and the image is too small for MS-SSIM
        assert [report["ef_psnr"] is None, report["region_report"] is None] == [regions == "none"] * 2
        assert report["ms_ssim"] is None

        metrics = json.loads(kcgs("eval", "scene.safetensors", "photo.png", "--json").out)
        assert set(metrics) >= KEYS | {"ssimulacra2"}
        assert metrics["psnr"] == pytest.approx(report["psnr"], abs=1e-4)
        assert json.loads(kcgs("info", "scene.safetensors", "--json").out)["height"] == 40

    def test_same_scene_as_in_python(self, kcgs: Kcgs) -> None:
        """The default output is named after the image."""
        save_image("large.png", load_image("photo.png").repeat_interleave(2, 1).repeat_interleave(2, 2))
        assert "psnr" in kcgs("fit", "large.png", "-n", "12", "--iterations", "20").out
        image, scene = load_image("large.png"), load("large.safetensors")
        result = fit(image, segment(image), 12, iterations=20)
        for name in ("means", "cholesky", "colors", "region_ids"):
            assert torch.equal(getattr(scene.field, name), getattr(result.scene.field, name)), name
        assert scene.regions is not None and result.scene.regions is not None
        assert torch.equal(scene.regions.labels, result.scene.regions.labels)

    def test_small_images_have_no_regions(self, kcgs: Kcgs) -> None:
        assert kcgs(*FIT, "--iterations", "5").out.endswith("regions: none, for a side is below 64 pixels\n")
        assert load("scene.safetensors").regions is None

    def test_grey(self, kcgs: Kcgs) -> None:
        """Scenes of one channel are compared with, and compressed by, the luma of an image."""
        report = json.loads(kcgs(*FIT, "--regions", "mask.png", "--grey", "--json").out)
        scene = load("scene.safetensors")
        assert scene.render().shape == (1, 40, 60)
        assert float(psnr(scene.render(), load_image("photo.png", channels="L"))) == pytest.approx(report["psnr"])
        assert json.loads(kcgs("eval", "scene.safetensors", "photo.png", "--json").out)["psnr"] == report["psnr"]
        assert kcgs("encode", "scene.safetensors", "--image", "photo.png", "-o", "grey.kcgs").code == 0
        assert load("grey.kcgs").render().shape == (1, 40, 60)

    def test_bounded(self, kcgs: Kcgs) -> None:
        assert kcgs(*FIT, "--bounded").code == 0
        field = load("scene.safetensors").field
        assert ((field.means >= 0) & (field.means <= torch.tensor([60.0, 40.0]))).all()
        assert field.colors.min() >= -1 and field.colors.max() <= 2

    def test_keep_contours(self, kcgs: Kcgs) -> None:
        assert "\nregions: 2 of 2 regions kept\n" in kcgs(*FIT, "--regions", "mask.png", "--keep-contours").out
        regions = load("scene.safetensors").regions
        assert regions is not None and torch.equal(regions.labels, load_labels("mask.png"))

    def test_regions_that_a_file_loses(self, kcgs: Kcgs) -> None:
        """Stripes save no error; what keeps them is said."""
        height, width = load_image("photo.png").shape[1:]
        save_labels("stripes.png", (torch.arange(width) // 3 % 2).expand(height, width))
        run = kcgs("fit", "photo.png", "--regions", "stripes.png", "--iterations", "5", "--target-bytes", "200")
        assert run.out.endswith(". --keep-contours keeps them\n")

    def test_recipe(self, kcgs: Kcgs) -> None:
        kcgs(*FIT, "--recipe", "gaussian-image")
        scene = load("scene.safetensors")
        assert scene.metadata["recipe"] == "gaussian-image" and scene.regions is None

    @pytest.mark.usefixtures("clock")
    def test_max_seconds(self, kcgs: Kcgs) -> None:
        arguments = ("--regions", "none", "--iterations", "1000000", "--max-seconds", "2", "--json")
        report = json.loads(kcgs(*FIT, *arguments).out)
        assert (report["target_reached"], report["stop_reason"]) == (None, "seconds")

    def test_target_psnr(self, kcgs: Kcgs) -> None:
        arguments = ("--iterations", "100", "--target-psnr", "25", "-n", "200", "--regions", "mask.png", "--json")
        report = json.loads(kcgs(*FIT, *arguments).out)
        assert report["psnr"] >= 25 and report["target_reached"] is True and report["stop_reason"] == "target_psnr"
        assert report["num_gaussians"] < 100

    @pytest.mark.parametrize("suffix", ["safetensors", "kcgs"])
    def test_target_psnr_out_of_reach(self, kcgs: Kcgs, suffix: str) -> None:
        code, out, err = kcgs(*FIT[:-1], f"s.{suffix}", "--regions", "none", "--target-psnr", "90", "--json")
        report = json.loads(out)
        assert code == 1 and report["target_reached"] is False and report["stop_reason"] == "iterations"
        assert err == f"kcgs: --target-psnr 90 was not reached: {report['psnr']:.2f} dB is the best\n"
        assert float(psnr(load(f"s.{suffix}").render(), load_image("photo.png"))) == pytest.approx(report["psnr"])

    def test_target_bytes(self, kcgs: Kcgs) -> None:
        arguments = ("--regions", "none", "--iterations", "5", "--target-bytes", "200")
        report = json.loads(kcgs("fit", "photo.png", *arguments, "--json").out)
        assert report["bytes"] == Path("photo.kcgs").stat().st_size <= 200
        assert report["num_gaussians"] == load("photo.kcgs").num_gaussians
        assert report["bits_per_pixel"] == pytest.approx(8 * report["bytes"] / (40 * 60))

    def test_settings_that_a_file_does_not_take(self, kcgs: Kcgs) -> None:
        """They are refused before the image is read."""
        Path("photo.png").write_text("this is no image")
        for purpose, options in (("PSNR", ()), ("size", ("--target-bytes", 900))):
            for setting, value in (("--recipe=paper", "'l1'"), ("--bounded", "True")):
                code, _, err = kcgs("fit", "photo.png", "-o", "photo.kcgs", *options, setting)
                assert code == 2 and f"for a file of a {purpose}; got {value}" in err, err
        assert "'--device': must be one that torch has" in kcgs("fit", "photo.png", "--device", "tpu").err

    def test_least_width_of_a_file(self, kcgs: Kcgs) -> None:
        """A file keeps the least width, but for its rounding."""
        assert kcgs(*FIT[:-1], "photo.kcgs", "--regions", "none", "--min-sigma", "2").code == 0
        assert min_sigma(load("photo.kcgs")) > 1.5

    def test_interrupt_saves_the_best_so_far(self, kcgs: Kcgs, monkeypatch: pytest.MonkeyPatch) -> None:
        def interrupt_third_step(handler: InterruptHandler, iteration: int, entry: Any) -> bool:
            if iteration == 3:
                signal.raise_signal(signal.SIGINT)
            return handler.count > 0

        monkeypatch.setattr(InterruptHandler, "on_step", interrupt_third_step)
        code, out, err = kcgs(*FIT, "--regions", "mask.png", "--json")
        assert code == 130 and err == "kcgs: interrupted: saved the best so far to scene.safetensors\n"
        assert json.loads(out)["stop_reason"] == "interrupted"
        assert 1 <= load("scene.safetensors").num_gaussians <= 12

    def test_second_interrupt_ends_the_command(self) -> None:
        with InterruptHandler():
            signal.raise_signal(signal.SIGINT)
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)

    @pytest.mark.filterwarnings("default")
    def test_warnings_are_lines_and_undefined_values_no_numbers(self, kcgs: Kcgs) -> None:
        Image.new("RGBA", (40, 30), (255, 0, 0, 9)).save("clear.png")
        code, out, err = kcgs("fit", "clear.png", "-n", "5", "--iterations", "2", "-q", "--regions", "none")
        assert (code, err) == (0, "warning: clear.png has transparent pixels: they are composed on white\n")
        assert "nan" not in out and out.count("not defined") == 3

    @pytest.mark.parametrize("option", ["--json", "--quiet", "--keep-contours"])
    def test_log(self, kcgs: Kcgs, option: str) -> None:
        kcgs("fit", "photo.png", "-n", "3", "--iterations", "2", option)
        assert logging.getLogger("kcgs").isEnabledFor(logging.INFO) == (option == "--keep-contours")


@pytest.mark.usefixtures("photo")
class TestRender:
    def test_sizes(self, kcgs: Kcgs) -> None:
        for option, size in (("--size=90x50", (50, 90)), ("--scale=0.5", (100, 150))):
            report = json.loads(kcgs("render", "zoo:chart-2x3", "-o", "a.png", option, "--json").out)
            assert load_image("a.png").shape == (3, *size)
            assert report == {"height": size[0], "width": size[1], "bytes": Path("a.png").stat().st_size}

    def test_a_batch_is_refused_by_its_name(self, kcgs: Kcgs) -> None:
        Scene(GaussianField.stack([GaussianField.random(3, (8, 8), seed=0)] * 2)).save("batch.safetensors")
        assert json.loads(kcgs("info", "batch.safetensors", "--json").out)["images"] == 2
        for arguments in (("eval", "photo.png"), ("encode", "-o", "a.kcgs"), ("view",), ("export", "-o", "a.onnx")):
            code, _, err = kcgs(arguments[0], "batch.safetensors", *arguments[1:])
            assert code == 2 and "must be of one image; got a batch of 2: scene[t] is one of them" in err, err


RENDER = ("render", "zoo:chart-pie", "-o", "a.png")


def test_metrics_that_are_not_defined_say_why(kcgs: Kcgs, monkeypatch: pytest.MonkeyPatch, photo: None) -> None:
    monkeypatch.setitem(sys.modules, "ssimulacra2", None)
    assert kcgs(*FIT, "--regions", "none").code == 0
    out = kcgs("eval", "scene.safetensors", "photo.png").out
    assert "not defined: a side is below 161 pixels" in out and "not defined: no contours" in out
    assert "not defined: it needs pip install ssimulacra2" in out


class TestFailures:
    @pytest.mark.parametrize(
        ("arguments", "code", "words"),
        [
            ((), 2, "Usage"),
            (("fitt",), 2, "fitt"),
            (("fit", "photo.png", "-n", "0"), 2, "greater than or equal to 1"),
            (("fit", "photo.png", "-n", "10000"), 2, "must be at most 2400, the pixels of the 60 x 40 image"),
            (("fit", "photo.png", "--objective", "visual"), 2, "one of l2, l1, ms-ssim; got 'visual'"),
            (("fit", "photo.png", "--objective", "psnr"), 2, "got 'psnr', which is now 'l2'"),
            (("fit", "text.png"), 1, "text.png"),
            (("fit", "photo.png", "--recipe", "none-such"), 2, "'--recipe': must be one of"),
            (("fit", "photo.png", "--regions", "nothing.png"), 2, "No such file or directory: nothing.png"),
            (("fit", "photo.png", "--regions", "small.png"), 2, "'--regions': must be one map of the image's size"),
            (("fit", "photo.png", "-o", "scene.KCGS"), 2, "must end in .safetensors"),
            (("fit", "photo.png", "--max-seconds", "-1"), 2, "'--max-seconds': must be greater than 0; got -1.0"),
            (("fit", "photo.png", "-n", "5", "--target-bytes", "90"), 2, "must be left out with --target-bytes; got 5"),
            (("fit", "photo.png", "--target-bytes", "90", "-o", "a.safetensors"), 2, "must end in .kcgs"),
            (("fit", "folder"), 2, "'IMAGE': file 'folder' is a directory"),
            (("info", "text.png"), 2, "'SCENE': must end in .safetensors or .kcgs, or be zoo:NAME; got 'text.png'"),
            (("info", "zoo:nothing"), 2, "zoo entry must be one of"),
            (("info", "nothing.kcgs"), 2, "kcgs: No such file or directory: nothing.kcgs"),
            (("encode", "zoo:chart-pie", "-o", "a.kcgs", "--quality", "500"), 2, "'--quality': must be in [10, 90]"),
            (("encode", "zoo:chart-pie", "-o", "a.kcgs", "--objective", "l2"), 2, "left out with a scene without"),
            (("segment", "photo.png", "-o", "a.png", "--method", "magic"), 2, "'--method': must be one of"),
            ((*RENDER, "--device", "cuda"), 2, "No such option: --device, which is one of kcgs fit, kcgs fit-many"),
            ((*RENDER, "--size", "90"), 2, "'--size': must be WxH"),
            ((*RENDER, "--size", "0x5"), 2, "'--size': must be at least 1 x 1"),
            ((*RENDER, "--scale", "-1"), 2, "'--scale': must be in (0, 1e+06]; got -1.0"),
            ((*RENDER, "--scale", "2", "--size", "4x4"), 2, "'--scale': must be left out with --size; got 2.0"),
        ],
    )
    @pytest.mark.usefixtures("photo")
    def test_message_and_exit_status(self, kcgs: Kcgs, arguments: tuple[str, ...], code: int, words: str) -> None:
        Path("text.png").write_text("this is no image")
        Path("folder").mkdir()
        save_labels("small.png", torch.zeros(4, 4, dtype=torch.long))
        before = set(Path().iterdir())
        run = kcgs(*arguments)
        assert run.code == code and words in run.out + run.err
        if code == 1:
            assert run.err.startswith("kcgs: ") and run.err.count("\n") == 1
        assert set(Path().iterdir()) == before


def test_demo(tmp_path: Path, astronaut: torch.Tensor, kcgs: Kcgs, monkeypatch: pytest.MonkeyPatch) -> None:
    small, compare = torch.nn.functional.avg_pool2d(astronaut, 8), demo.compare
    monkeypatch.setattr(demo, "compare", lambda output, *_, **__: compare(output, small, 300, iterations=3))
    code, out, err = kcgs("demo", "-o", tmp_path / "demo")
    assert code == 0, err
    names = {path.name for path in (tmp_path / "demo").iterdir()}
    assert {"original.png", "regions.png", "baseline.png", "contour-aware.png", "comparison.png"} <= names
    for name in ("baseline", "contour-aware"):
        assert (tmp_path / "demo" / f"{name}.kcgs").stat().st_size <= 300
    assert "contour-aware" in out and "EF-PSNR" in out
