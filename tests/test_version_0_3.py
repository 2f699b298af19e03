"""What version 0.3 wrote is read, and what it named is named in the error that says the new name."""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any

import pytest
import torch

from kcgs import FitConfig, fit, load
from kcgs.data import load_image
from kcgs.fitting import make_problem
from kcgs.fitting.checkpoint_0_3 import from_0_3
from kcgs.segment import segment

FILES = Path(__file__).parent / "version_0_3"
IMAGE = torch.rand(3, 24, 32, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize(("file", "render"), [("scene.safetensors", "scene.png"), ("scene.kcgs", "scene.kcgs.png")])
def test_scenes_are_read(file: str, render: str) -> None:
    scene = load(FILES / file)
    assert scene.regions is not None
    # the render of 0.3 has 8 bits
    assert (scene.render() - load_image(FILES / render)).abs().max() <= 0.501 / 255


def test_softness_of_pairs_is_read() -> None:
    regions = load(FILES / "scene.safetensors").regions
    assert regions is not None
    assert regions.softness == {(0, 3): 0.5, (3, 7): 0.0, (0, 7): 1.25}


def test_videos_are_read() -> None:
    video = load(FILES / "video.safetensors")
    assert video.num_images == 2 and video.metadata == {"frame_rate": "24"}
    assert (video.render()[1] - load_image(FILES / "video.png")).abs().max() <= 0.501 / 255


@pytest.mark.parametrize(
    ("file", "recipe", "guided"), [("fit", "best", True), ("gaussian-image", "gaussian-image", False)]
)
def test_checkpoints_are_continued(tmp_path: Path, file: str, recipe: str, guided: bool) -> None:
    """The files are of fits that were killed after 60 of 100 iterations."""
    y, x = torch.meshgrid(torch.arange(24.0), torch.arange(32.0), indexing="ij")
    labels = ((x - 14) ** 2 + (y - 11) ** 2 < 64).long()
    image = (torch.stack([0.8 * labels + 0.1, x / 40, y / 30]) * 255).round() / 255
    path = tmp_path / "state"
    path.write_bytes((FILES / f"{file}.state").read_bytes())
    arguments: dict[str, Any] = {"recipe": recipe, "iterations": 100, "checkpoint": path, "resume": True}
    with pytest.raises(ValueError, match="belongs to another fit"):
        fit(image, labels if guided else None, 41, **arguments)
    seen: list[int] = []
    resumed = fit(image, labels if guided else None, 40, on_step=lambda i, _: seen.append(i), **arguments)
    whole = fit(image, labels if guided else None, 40, recipe=recipe, iterations=100)
    assert seen == [*range(61, 101)]
    assert [entry.iteration for entry in resumed.history] == [entry.iteration for entry in whole.history]
    # the fits up to 60 have the same bits only on machines of one kind
    assert resumed.psnr == pytest.approx(whole.psnr, abs=0.5)


def test_checkpoints_of_a_scene_without_error_are_read() -> None:
    content = torch.load(io.BytesIO((FILES / "fit.state").read_bytes()[32:]), weights_only=True)
    problem = make_problem(IMAGE, None, 40, FitConfig(), 0)
    assert float(from_0_3({**content, "best_value": 0.0}, problem)["best"]["numbers"][2]) == math.inf


@pytest.mark.parametrize(
    ("call", "replacement"),
    [
        (lambda: fit(IMAGE, objective="psnr"), "'l2'"),
        (lambda: fit(IMAGE, objective="auto"), "leave it out"),
        (lambda: fit(IMAGE, loss="l1"), "objective"),
        (lambda: fit(IMAGE, recipe="image-gs"), "benchmarks/core/image_gs.py"),
        (lambda: fit(IMAGE, initializer="gradient"), "benchmarks/core/image_gs.py"),
        (lambda: fit(IMAGE, densify="largest-error"), "benchmarks/core/image_gs.py"),
        (lambda: fit(IMAGE, optimizer="adam"), "benchmarks/core/image_gs.py"),
        (lambda: FitConfig(densify="matching-pursuit"), "argument of fit"),
        (lambda: FitConfig().num_iterations, "planned_iterations"),
        (lambda: FitConfig().max_iterations, "iteration_limit"),
        (lambda: segment(IMAGE, "sam", boxes=[[1, 1, 9, 9]]), "box"),
    ],
)
def test_old_names_end_in_an_error_with_the_new_name(call: Any, replacement: str) -> None:
    with pytest.raises((ValueError, TypeError, AttributeError), match=replacement):
        call()
