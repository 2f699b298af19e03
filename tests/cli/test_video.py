"""Videos on the command line: fitted to a batch of scenes, rendered at any rate and size, described."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from torch import Tensor

from kcgs import Scene, load
from kcgs.data import load_image, save_labels
from kcgs.functional import psnr
from kcgs.video import fit_video, interpolate, read_video, write_video
from tests.cli.conftest import Kcgs

FIT = ("fit-video", "frames", "-n", "20", "--iterations", "5", "-q", "-o", "a.safetensors")
COUNT = 3


def make_frames() -> list[Tensor]:
    coarse = torch.rand(1, 3, 16, 28, generator=torch.Generator().manual_seed(0))
    wide = torch.nn.functional.interpolate(coarse, (32, 56), mode="bicubic").clamp(0, 1)[0] / 2
    wide += 0.5 * (torch.arange(56) >= 20)  # make_labels knows this edge
    return [wide[:, :, 2 * number : 2 * number + 48].contiguous() for number in range(COUNT)]


def make_labels(shift: int = 0) -> Tensor:
    return (torch.arange(48) >= 20 - shift).long().expand(32, 48).contiguous()


@pytest.fixture(scope="module")
def batch() -> Scene:
    scenes = fit_video(make_frames(), make_labels(), 20, iterations=5)
    return Scene(scenes.field, scenes.regions, {"frame_rate": "12"})


@pytest.fixture(autouse=True)
def _files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, batch: Scene) -> None:
    monkeypatch.chdir(tmp_path)
    write_video("frames", make_frames(), 12)
    save_labels("mask.png", make_labels())
    batch.save("clip.safetensors")


class TestFitVideo:
    def test_json(self, kcgs: Kcgs) -> None:
        code, out, err = kcgs(*FIT, "--regions", "mask.png", "--frame-rate", "12", "--json")
        assert (code, err) == (0, "")
        report = json.loads(out)
        names = ("frames", "width", "height", "frame_rate", "num_gaussians", "regions")
        assert [report[name] for name in names] == [COUNT, 48, 32, 12.0, 20, 2]
        assert report["bytes"] == Path("a.safetensors").stat().st_size and report["psnr"] >= report["psnr_least"] > 10
        scenes = load("a.safetensors")
        assert len(scenes) == COUNT and scenes.metadata["frame_rate"] == "12"

    def test_a_folder_gets_one_scene_per_frame(self, kcgs: Kcgs) -> None:
        arguments = (*FIT[:-1], "scenes", "--regions", "mask.png")
        assert kcgs(*arguments).code == 0
        assert [path.name for path in sorted(Path("scenes").iterdir())] == [
            f"0000{t}.safetensors" for t in range(COUNT)
        ]
        assert load("scenes/00001.safetensors").num_gaussians == 20
        code, _, err = kcgs(*arguments)
        assert (code, err) == (1, "kcgs: scenes exists; --overwrite replaces it\n")

    def test_maps_of_every_frame(self, kcgs: Kcgs) -> None:
        Path("masks").mkdir()
        for number in range(COUNT):
            save_labels(f"masks/{number}.png", make_labels(2 * number))
        kcgs(*FIT, "--regions", "masks")
        regions = load("a.safetensors").regions
        assert regions is not None and regions.labels.shape == (COUNT, 32, 48)

    @pytest.mark.parametrize(
        ("arguments", "code", "words"),
        [
            (("-o", "a.kcgs"), 2, "must end in .safetensors"),
            (("-o", "mask.png/scenes", "--regions", "nothing.png"), 2, "--output needs an existing folder"),
            (("--objective", "l1", "--regions", "nothing.png"), 2, "'--objective': must be l2 or ms-ssim for a video"),
        ],
    )
    def test_wrong_usage(self, kcgs: Kcgs, arguments: tuple[str, ...], code: int, words: str) -> None:
        run = kcgs("fit-video", "frames", *arguments)
        assert run.code == code and words in run.err


class TestRender:
    def test_folder(self, kcgs: Kcgs, batch: Scene) -> None:
        arguments = ("-o", "out", "--frame-rate", "24", "--scale", "2", "--json")
        report = json.loads(kcgs("render", "clip.safetensors", *arguments).out)
        assert report == {"frames": 2 * COUNT - 1, "height": 64, "width": 96}
        assert len(list(Path("out").iterdir())) == 2 * COUNT - 1
        expected = interpolate(batch, 0.5).render((64, 96))
        assert (load_image("out/00001.png") - expected).abs().max() < 0.6 / 255

    def test_video(self, kcgs: Kcgs, batch: Scene) -> None:
        pytest.importorskip("av", reason="video files need PyAV: pip install av")
        assert kcgs("render", "clip.safetensors", "-o", "out.mp4").code == 0
        video = read_video("out.mp4")
        assert video.frame_rate == 12 and video.size == (32, 48)
        for image, scene in zip(video, batch, strict=True):
            assert psnr(image, scene.render()) > 30

    def test_frame(self, kcgs: Kcgs, batch: Scene) -> None:
        kcgs("render", "clip.safetensors", "-o", "a.png", "--frame", "1")
        assert (load_image("a.png") - batch[1].render()).abs().max() < 0.6 / 255

    @pytest.mark.parametrize(
        ("arguments", "words"),
        [
            (("-o", "a.png"), "must end in .mp4 or .mov or .mkv; got 'a.png'"),
            (("-o", "a.mp4", "--frame-rate", "0"), "'--frame-rate': must be in (0, 1000]; got 0.0"),
            (("-o", "a.png", "--frame", "9"), "'--frame': must be in [0, 2] frames"),
            (("-o", "a.png", "--frame", "1", "--frame-rate", "9"), "'--frame-rate': must be left out with --frame"),
        ],
    )
    def test_wrong_usage(self, kcgs: Kcgs, arguments: tuple[str, ...], words: str) -> None:
        code, _, err = kcgs("render", "clip.safetensors", *arguments)
        assert code == 2 and words in err


def test_info(kcgs: Kcgs) -> None:
    report = json.loads(kcgs("info", "clip.safetensors", "--json").out)
    assert (report["images"], report["num_gaussians"], report["metadata.frame_rate"]) == (COUNT, 20, "12")
