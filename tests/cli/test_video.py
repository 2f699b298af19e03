"""Videos on the command line: fitted to a batch of scenes, rendered at any rate and size, described."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor

import kcgs.cli
from kcgs import load
from kcgs.data import load_image, save_labels
from kcgs.functional import psnr
from kcgs.video import interpolate, read_video, write_video

Run = Callable[..., tuple[int, str, str]]
FIT = ("fit-video", "frames", "-n", "30", "--iterations", "20", "-q")
COUNT = 4


def make_frames() -> list[Tensor]:
    coarse = torch.rand(1, 3, 16, 28, generator=torch.Generator().manual_seed(0))
    wide = torch.nn.functional.interpolate(coarse, (32, 56), mode="bicubic").clamp(0, 1)[0] / 2
    wide += 0.5 * (torch.arange(56) >= 20)  # make_labels knows this edge
    return [wide[:, :, 2 * number : 2 * number + 48].contiguous() for number in range(COUNT)]


def make_labels(shift: int = 0) -> Tensor:
    return (torch.arange(48) >= 20 - shift).long().expand(32, 48).contiguous()


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    monkeypatch.chdir(tmp_path)
    write_video("frames", make_frames(), 12)
    save_labels("mask.png", make_labels())

    def call(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["kcgs", *arguments])
        code = 0
        try:
            kcgs.cli.main()
        except SystemExit as stop:
            code = int(stop.code or 0)
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return call


@pytest.fixture
def scenes(run: Run) -> Run:
    assert run(*FIT, "--regions", "mask.png", "--frame-rate", "12", "-o", "clip.safetensors")[0] == 0
    return run


class TestFitVideo:
    def test_json(self, run: Run) -> None:
        code, out, err = run(*FIT, "--regions", "mask.png", "--frame-rate", "12", "-o", "a.safetensors", "--json")
        report = json.loads(out)
        assert (code, err) == (0, "")
        names = ("frames", "width", "height", "frame_rate", "num_gaussians", "regions")
        assert [report[name] for name in names] == [COUNT, 48, 32, 12.0, 30, 2]
        assert report["bytes"] == os.path.getsize("a.safetensors") and report["psnr"] >= report["psnr_least"] > 15
        saved = load("a.safetensors")
        assert len(saved) == COUNT and saved.metadata["frame_rate"] == "12"

    def test_maps_of_every_frame(self, run: Run) -> None:
        os.mkdir("masks")
        for number in range(COUNT):
            save_labels(f"masks/{number}.png", make_labels(2 * number))
        assert run(*FIT, "--regions", "masks", "-o", "a.safetensors")[0] == 0
        regions = load("a.safetensors").regions
        assert regions is not None and regions.labels.shape == (COUNT, 32, 48)

    def test_some_frames(self, run: Run) -> None:
        assert run(*FIT, "--regions", "mask.png", "-o", "a.safetensors", "--frames", "2")[0] == 0
        assert len(load("a.safetensors")) == 2

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (("fit-video", "frames", "-o", "a.kcgs"), "must end in .safetensors"),
            (("fit-video", "frames", "--regions", "nothing.png"), "nothing.png"),
            (("fit-video", "frames", "--max-seconds", "3"), "No such option"),
        ],
    )
    def test_wrong_usage(self, run: Run, arguments: tuple[str, ...], message: str) -> None:
        code, _, err = run(*arguments)
        assert code in (1, 2) and message in err


class TestRender:
    def test_folder(self, scenes: Run) -> None:
        assert scenes("render", "clip.safetensors", "-o", "out", "--frame-rate", "24", "--scale", "2")[0] == 0
        assert len(os.listdir("out")) == 2 * COUNT - 1
        want = interpolate(load("clip.safetensors"), 0.5).render((64, 96))
        assert (load_image("out/00001.png") - want).abs().max() < 0.6 / 255

    def test_video(self, scenes: Run) -> None:
        pytest.importorskip("av", reason="video files need PyAV: pip install 'kcgs[video]'")
        assert scenes("render", "clip.safetensors", "-o", "out.mp4")[0] == 0
        video = read_video("out.mp4")
        assert video.frame_rate == 12 and video.size == (32, 48)
        for image, scene in zip(video, load("clip.safetensors"), strict=True):
            assert psnr(image, scene.render()) > 30

    def test_frame(self, scenes: Run) -> None:
        assert scenes("render", "clip.safetensors", "-o", "a.png", "--frame", "1")[0] == 0
        assert (load_image("a.png") - load("clip.safetensors")[1].render()).abs().max() < 0.6 / 255

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (("-o", "a.png"), "--output must end in .mp4 or .mov or .mkv"),
            (("-o", "a.mp4", "--frame-rate", "0"), "--frame-rate must be in (0, 1000]; got 0.0"),
            (("-o", "a.png", "--frame", "9"), "--frame must be in [0, 3] frames"),
            (("-o", "a.png", "--frame", "1", "--frame-rate", "9"), "--frame excludes --frame-rate"),
        ],
    )
    def test_wrong_usage(self, scenes: Run, arguments: tuple[str, ...], message: str) -> None:
        code, _, err = scenes("render", "clip.safetensors", *arguments)
        assert code == 2 and message in err


def test_info(scenes: Run) -> None:
    report = json.loads(scenes("info", "clip.safetensors", "--json")[1])
    assert (report["images"], report["num_gaussians"], report["metadata.frame_rate"]) == (COUNT, 30, "12")


@pytest.mark.parametrize(
    "arguments", [("encode", "-o", "a.kcgs"), ("eval", "frames/00000.png"), ("export", "-o", "a.html"), ("view",)]
)
def test_commands_of_one_image_name_an_image(scenes: Run, arguments: tuple[str, ...]) -> None:
    code, _, err = scenes(arguments[0], "clip.safetensors", *arguments[1:])
    assert code in (1, 2) and "scene[t] is one of them" in err
