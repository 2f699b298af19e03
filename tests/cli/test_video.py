"""Clips on the command line: fitted, rendered, described, compared."""

from __future__ import annotations

import base64
import json
import os
import signal
import sys
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import kcgs.cli
from kcgs import Clip, GaussianField, Scene
from kcgs.data import load_image, read_video, save_image, save_labels, write_video
from kcgs.functional import psnr

Run = Callable[..., tuple[int, str, str]]
FIT = ("fit-video", "frames", "-n", "30", "--iterations", "20", "-q")
FRAMES = 4


def make_frames() -> list[Tensor]:
    coarse = torch.rand(1, 3, 16, 28, generator=torch.Generator().manual_seed(0))
    wide = torch.nn.functional.interpolate(coarse, (32, 56), mode="bicubic").clamp(0, 1)[0] / 2
    wide += 0.5 * (torch.arange(56) >= 20)  # make_labels knows this edge
    return [wide[:, :, 2 * number : 2 * number + 48].contiguous() for number in range(FRAMES)]


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


def make_labels(shift: int = 0) -> Tensor:
    return (torch.arange(48) >= 20 - shift).long().expand(32, 48).contiguous()


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    labels = make_labels()
    return kcgs.fit_video(make_frames(), labels, 40, frame_rate=12, iterations=20).to_bytes()


@pytest.fixture
def clip(run: Run, fitted: bytes) -> Clip:
    Path("clip.kcgs").write_bytes(fitted)
    return Clip.load("clip.kcgs")


class TestFitVideo:
    def test_a_folder(self, run: Run) -> None:
        code, out, err = run(*FIT, "--regions", "none", "--first", "3", "--frame-rate", "30000/1001", "--json")
        assert (code, err) == (0, "")
        report, clip = json.loads(out), Clip.load("frames.kcgs")
        assert len(clip) == report["frames"] == 3 and clip.frame_rate == Fraction(30000, 1001)
        assert report["bytes"] == Path("frames.kcgs").stat().st_size
        assert report["kbps"] == pytest.approx(8 * report["bytes"] / 1000 / (3 * 1001 / 30000))
        assert report["bits_per_pixel"] == pytest.approx(8 * report["bytes"] / (3 * 32 * 48))
        values = [float(psnr(clip[k].render(), load_image(f"frames/{k:05d}.png"))) for k in range(3)]
        assert report["psnr"] == pytest.approx(sum(values) / 3, abs=1e-3) and report["ef_psnr"] is None
        assert report["key_frames"] == list(clip.key_frames) and report["stop_reason"] == "end"
        assert report["num_gaussians"] == len(clip[0]) and report["seconds"] > 0
        assert clip.key_frames == (0,) and report["core_seconds_per_carried_frame"] > 0

    def test_a_file_is_the_clip_of_its_frames(self, run: Run) -> None:
        pytest.importorskip("av")
        write_video("video.mp4", make_frames()[:2], 25)
        assert run("fit-video", "video.mp4", *FIT[2:], "--regions", "none", "-o", "a.kcgs", "--seed", "3")[0] == 0
        video = read_video("video.mp4")
        same = kcgs.fit_video(video, None, 30, frame_rate=25, iterations=20, seed=3)
        assert Path("a.kcgs").read_bytes() == same.to_bytes()

    def test_regions(self, run: Run) -> None:
        Path("masks").mkdir()
        for number in range(3):
            save_labels(f"masks/{number}.png", make_labels(2 * number))
        arguments = (*FIT, "--first", "2", "-n", "40")
        said = {"masks": "masks, as given", "mask.png": "mask.png, as carried"}
        for regions, contours in said.items():
            code, out, err = run(*arguments, "--regions", regions)
            assert code == 0, err
            assert f"│ along the contours of {contours}" in out and "not defined" in out
            clip = Clip.load("frames.kcgs")
            assert clip[0].regions is not None and clip[0].regions.num_regions == 2
        code, out, err = run(*FIT, "--regions", "masks")
        assert (code, err) == (2, "kcgs: --regions must have a map for each of 4 frames; got 3 in masks\n")
        save_labels("masks/0.png", make_labels()[:9])
        code, out, err = run(*FIT, "--regions", "masks", "--first", "1")
        assert code == 2 and err.startswith("kcgs: --regions must have maps of the size (32, 48) of VIDEO; got (9, 48)")
        assert run(*FIT, "--regions", "nothing")[::2] == (
            1, "kcgs: --regions must be auto, none, a label map or a folder of them; no such file: nothing\n",
        )  # fmt: skip

    @pytest.mark.parametrize("counted", [True, False])
    def test_so_many_bytes(self, run: Run, monkeypatch: pytest.MonkeyPatch, counted: bool) -> None:
        if not counted:  # as of files that do not say it
            monkeypatch.setattr(
                "kcgs.data._frames.ImageFolder.num_frames", property(lambda _: None, lambda *_: None), raising=False
            )
        arguments = ("fit-video", "frames", "--iterations", "20", "--regions", "none", "--json", "-q")
        code, out, err = run(*arguments, "--target-bytes", "700")
        assert (code, err) == (0, "")
        report = json.loads(out)
        assert 500 < report["bytes"] <= 700 and report["target_reached"] is True
        if counted:
            code, out, err = run(*arguments, "--kbps", "28", "--frame-rate", "20")
            assert code == 0 and 20 < json.loads(out)["kbps"] <= 28, err
        else:
            assert run(*FIT, "--regions", "none", "--first", "1")[0] == 0

    def test_a_clip_that_is_too_large(self, run: Run, monkeypatch: pytest.MonkeyPatch, clip: Clip) -> None:
        monkeypatch.setattr("kcgs.rate.video.fit_video", lambda *_, **__: clip)
        for option, message in (
            (("--target-bytes", "300"), f"--target-bytes 300 was not reached: {clip.num_bytes} is the least"),
            (("--kbps", "2"), f"--kbps 2 was not reached: {8 * clip.num_bytes * 12 / FRAMES / 1000:.4g} is the least"),
        ):
            code, out, err = run(*FIT, "--regions", "none", "--json", *option)
            assert (code, err) == (1, f"kcgs: {message}\n") and json.loads(out)["target_reached"] is False
        assert run(*FIT, "--target-bytes", "9", "--kbps", "9")[0] == 2

    def test_found_regions(self, run: Run) -> None:
        code, out, err = run(*FIT, "--first", "1", "--json")
        assert code == 0 and json.loads(out)["frames"] == 1, err

    def test_interrupt_keeps_the_frames_that_are_done_and_resume_goes_on(
        self, run: Run, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        step = kcgs.cli.common.Stop.step

        def pressed(stop: Any, number: int, report: Any) -> bool:
            step(stop, number, report)
            if number == 1:
                os.kill(os.getpid(), signal.SIGINT)
            return step(stop, number, report)

        arguments = (*FIT, "--regions", "none", "--json", "--checkpoint", "state", "--resume", "-o", "a.kcgs")
        with monkeypatch.context() as patch:
            patch.setattr(kcgs.cli.common.Stop, "step", pressed)
            code, out, err = run(*arguments)
        assert code == 130 and len(Clip.load("a.kcgs")) == 2
        assert err == "kcgs: interrupted: saved the 2 frames that are done to a.kcgs; --resume goes on\n"
        assert json.loads(out)["stop_reason"] == "interrupted" and json.loads(out)["frames"] == 2
        code, out, err = run(*arguments)
        assert code == 0 and json.loads(out)["frames"] == FRAMES, err
        assert run(*FIT, "--regions", "none", "-o", "b.kcgs")[0] == 0
        assert Path("a.kcgs").read_bytes() == Path("b.kcgs").read_bytes()
        code, _, err = run(*arguments, "--seed", "1")
        assert code == 1 and "is of a fit with other arguments" in err

    def test_a_frame_that_cannot_be_read_keeps_those_before(self, run: Run) -> None:
        Path("frames/00002.png").write_bytes(Path("frames/00002.png").read_bytes()[:300])
        code, out, err = run(*FIT, "--regions", "none", "--json", "-o", "a.kcgs")
        assert code == 1 and len(Clip.load("a.kcgs")) == 2 and err.count("\n") == 1
        assert "00002.png" in err and err.endswith("; saved the 2 frames that are done to a.kcgs\n")
        assert json.loads(out)["stop_reason"] == "error"
        save_image("frames/00000.png", torch.zeros(3, 8, 9))
        code, out, err = run(*FIT, "--regions", "none", "-o", "b.kcgs")
        assert code == 1 and "│ frames         │ 1" in out and len(Clip.load("b.kcgs")) == 1
        assert "00001.png" in err and err.endswith("; saved the frame that is done to b.kcgs\n")

    @pytest.mark.parametrize(
        ("arguments", "code", "message"),
        [
            (("fit-video", "nothing"), 1, "no such file or folder: nothing"),
            (("fit-video", "mask.png"), 2, "kcgs fit fits it"),
            (("fit-video", "frames", "-o", "a.mp4"), 2, "--output must end in .kcgs"),
            (("fit-video", "frames", "--frame-rate", "0"), 2, "frames per second"),
            (("fit-video", "frames", "--resume"), 2, "--resume needs --checkpoint"),
            (("fit-video", "frames", "--max-seconds", "9"), 2, "No such option"),
            (("fit", "video.mp4"), 2, "kcgs fit-video fits videos"),
        ],
    )
    def test_wrong_usage(self, run: Run, arguments: tuple[str, ...], code: int, message: str) -> None:
        answer, out, err = run(*arguments)
        assert (answer, out) == (code, "") and message in " ".join(err.replace("│", "").split()), err


class TestRender:
    def test_a_folder_has_the_frames(self, run: Run, clip: Clip) -> None:
        assert run("render", "clip.kcgs", "-o", "out") == (0, "", "")
        files = sorted(Path("out").iterdir())
        assert len(files) == FRAMES
        for number, file in enumerate(files):
            assert (load_image(file) - clip[number].render()).abs().max() <= 0.51 / 255
        assert run("render", "clip.kcgs", "-o", "out")[0] == 1  # it is not empty

    @pytest.mark.parametrize(("rate", "count"), [("2x", 7), ("36", 10), ("6", 2)])
    def test_frames_in_between(self, run: Run, clip: Clip, rate: str, count: int) -> None:
        pytest.importorskip("av")
        arguments = ("--frame-rate", rate, "--scale", "2", "--contours", "crisp")
        assert run("render", "clip.kcgs", "-o", "out.mkv", *arguments)[0] == 0
        video = read_video("out.mkv")
        frames = list(video)
        assert len(frames) == count and video.size == (64, 96)
        assert video.frame_rate == (24 if rate == "2x" else int(rate))
        step = clip.frame_rate / video.frame_rate
        assert float(psnr(frames[1], clip.render(float(step), (64, 96), "crisp"))) > 30

    @pytest.mark.parametrize("suffix", ["mp4", "webm"])
    def test_kinds_of_video(self, run: Run, clip: Clip, suffix: str) -> None:
        pytest.importorskip("av")
        assert run("render", "clip.kcgs", "-o", f"out.{suffix}", "--size", "30x20")[0] == 0
        assert read_video(f"out.{suffix}").size == (20, 30)

    def test_one_time(self, run: Run, clip: Clip) -> None:
        assert run("render", "clip.kcgs", "-o", "out.png", "--frame", "1.5", "--size", "30x20")[0] == 0
        assert (load_image("out.png") - clip.render(1.5, (20, 30))).abs().max() <= 0.51 / 255

    def test_the_first_bytes_are_the_first_frames(self, run: Run, clip: Clip) -> None:
        part = clip.num_bytes - clip.frame_bytes[-1]
        assert run("decode", "clip.kcgs", "-o", "out", "--bytes", str(part))[0] == 0
        assert len(list(Path("out").iterdir())) == FRAMES - 1
        code, _, err = run("decode", "clip.kcgs", "-o", "none", "--bytes", "40")
        assert code == 1 and err == "kcgs: cannot decode clip.kcgs: the clip ends early: it holds no whole frame\n"
        Path("clip.kcgs").write_bytes(clip.to_bytes()[:part])
        code, _, err = run("render", "clip.kcgs", "-o", "none")
        begins = "kcgs: cannot load clip.kcgs: the clip ends early, after 3 whole frames"
        assert code == 1 and err == f"{begins}: kcgs decode --bytes, or whole=False, reads these\n"

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (("-o", "out.png"), "or come with --frame"),
            (("-o", "out.gif"), "--output must end in .mp4"),
            (("-o", "out.mp4", "--frame", "1"), "--output must end in .png"),
            (("-o", "out.png", "--frame", "3.5"), "--frame must be in [0, 3]"),
            (("-o", "out.png", "--frame", "1", "--frame-rate", "2x"), "--frame excludes --frame-rate"),
            (("-o", "out", "--frame-rate", "0x"), "Invalid value for '--frame-rate'"),
            (("-o", "out", "--region", "1"), "a clip excludes --region"),
            (("-o", "out", "--scale", "-1"), "--scale must be positive"),
        ],
    )
    def test_wrong_usage(self, run: Run, clip: Clip, arguments: tuple[str, ...], message: str) -> None:
        code, out, err = run("render", "clip.kcgs", *arguments)
        assert (code, out) == (2, "") and message in " ".join(err.replace("│", "").split()), err

    def test_options_of_clips_are_none_of_scenes(self, run: Run) -> None:
        Scene(GaussianField.random(5, (8, 9), seed=0)).save("still.kcgs")
        for option in (("--frame-rate", "2x"), ("--frame", "0")):
            code, _, err = run("render", "still.kcgs", "-o", "a.png", *option)
            assert code == 2 and f"a scene excludes {option[0]}" in err


class TestOtherCommands:
    def test_info(self, run: Run, clip: Clip) -> None:
        code, out, err = run("info", "clip.kcgs", "--json")
        assert (code, err) == (0, "")
        size = len(clip.to_bytes())
        assert json.loads(out) == {
            "holds": "clip", "height": 32, "width": 48, "frames": FRAMES, "frame_rate": 12.0,
            "clip_seconds": FRAMES / 12, "key_frames": list(clip.key_frames), "num_gaussians": len(clip[0]),
            "most_gaussians": max(map(len, clip)), "regions": 2, "bytes": size,
            "kbps": pytest.approx(8 * size / 1000 * 12 / FRAMES),
            "bits_per_pixel": pytest.approx(8 * size / (FRAMES * 32 * 48)),
        }  # fmt: skip
        assert "│ key_frames     │ 1 (0)" in run("info", "clip.kcgs")[1]

    def test_eval(self, run: Run, clip: Clip) -> None:
        code, out, err = run("eval", "clip.kcgs", "frames", "--json")
        assert (code, err) == (0, "")
        report = json.loads(out)
        values = [psnr(scene.render(), load_image(f"frames/{k:05d}.png")) for k, scene in enumerate(clip)]
        assert report["psnr"] == pytest.approx(float(sum(values) / FRAMES), abs=1e-3) and report["frames"] == FRAMES
        assert report["ef_psnr"] is not None
        Path("masks").mkdir()
        for number in range(FRAMES):
            save_labels(f"masks/{number}.png", make_labels(2 * number))
        code, out, err = run("eval", "clip.kcgs", "frames", "--regions", "masks")
        assert code == 0 and "│ along the contours of masks" in out, err
        save_image("frames/00004.png", make_frames()[3])
        code, _, err = run("eval", "clip.kcgs", "frames")
        assert (code, err) == (0, "kcgs: IMAGE has 5 frames; the first 4 are compared\n")
        Path("frames/00004.png").unlink()
        Path("masks/3.png").unlink()
        code, _, err = run("eval", "clip.kcgs", "frames", "--regions", "masks")
        assert (code, err) == (2, "kcgs: --regions must have a map for each of 4 frames; got 3\n")
        Path("frames/00002.png").unlink()
        code, _, err = run("eval", "clip.kcgs", "frames")
        assert (code, err) == (2, "kcgs: IMAGE must have the 4 frames of the clip; got 3\n")
        Path("small").mkdir()
        save_image("small/0.png", torch.zeros(3, 8, 9))
        code, _, err = run("eval", "clip.kcgs", "small")
        assert (code, err) == (2, "kcgs: IMAGE must have the size (32, 48) of SCENE; got (8, 9)\n")

    @pytest.mark.parametrize("arguments", [("encode", "-o", "a.kcgs"), ("export", "-o", "a.onnx")])
    def test_what_takes_scenes_only_says_what_a_clip_is_for(
        self, run: Run, clip: Clip, arguments: tuple[str, ...]
    ) -> None:
        code, out, err = run(arguments[0], "clip.kcgs", *arguments[1:])
        assert (code, out) == (1, "") and err == (
            "kcgs: cannot load clip.kcgs: it is a clip, no scene: kcgs render writes it as a video, kcgs.Clip.load "
            "reads it\n"
        )
        with pytest.raises(ValueError, match="kcgs.Clip.load reads it"):
            kcgs.load("clip.kcgs")

    def test_view_serves_the_page_of_a_clip(
        self, run: Run, clip: Clip, fitted: bytes, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        shown: list[tuple[str, bytes]] = []

        def serve(page: Path, *_: object, **__: object) -> None:
            shown.append(((page / "index.html").read_text(), (page / "scene.kcgs").read_bytes()))

        monkeypatch.setattr("kcgs.view._serve", serve)
        assert run("view", "clip.kcgs", "--contours", "crisp") == (0, "", "")
        ((page, data),) = shown
        assert data == fitted and 'contours="crisp" data-clip="scene/scene.kcgs"' in page
        assert "a clip excludes --original" in run("view", "clip.kcgs", "--original", "mask.png")[2]
        Path("clip.kcgs").write_bytes(fitted[:-9])
        assert run("view", "clip.kcgs")[0] != 0 and len(shown) == 1

    def test_export_writes_a_page(self, run: Run, clip: Clip, fitted: bytes) -> None:
        code, out, _ = run("export", "clip.kcgs", "-o", "clip.html", "--json")
        report, page = json.loads(out), Path("clip.html").read_text()
        assert code == 0 and report["frames"] == len(clip) and report["clip_bytes"] == len(fitted)
        assert base64.b64encode(fitted).decode() in page and report["bytes"] == len(page.encode())
        assert "it is a clip" in run("export", "clip.kcgs", "-o", "clip.onnx")[2]

    def test_eval_of_a_scene_takes_no_folder(self, run: Run) -> None:
        Scene(GaussianField.random(5, (32, 48), seed=0)).save("still.kcgs")
        assert "IMAGE must be a file" in run("eval", "still.kcgs", "frames")[2]
