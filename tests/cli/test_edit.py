"""`kcgs edit`, and the list of regions of `kcgs info`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from kcgs import GaussianField, Scene, editing, load, video
from tests.cli.conftest import Kcgs


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Scene:
    """Save a scene of three regions as scene.safetensors, and a batch of it as batch.safetensors."""
    monkeypatch.chdir(tmp_path)
    labels = torch.zeros(16, 24, dtype=torch.long)
    labels[2:6, 2:8], labels[8:14, 14:20] = 3, 7
    scene = Scene(GaussianField.random(30, (16, 24), regions=labels, seed=0), labels)
    scene.save("scene.safetensors")
    Scene(GaussianField.stack([scene.field] * 2), torch.stack([labels] * 2)).save("batch.safetensors")
    return scene


EDITS = ("--move", "7=-3,1", "--delete", "3")


def test_info_lists_regions(kcgs: Kcgs, scene: Scene) -> None:
    table = json.loads(kcgs("info", "scene.safetensors", "--json").out)["table"]
    assert [(row["id"], row["area"]) for row in table] == [(0, 324), (3, 24), (7, 36)]
    # centres of an even number of pixels lie between two
    assert (table[2]["x"], table[2]["y"]) in {(x, y) for x in (16, 17) for y in (10, 11)}
    mean = (255 * scene().detach().clamp(0, 1)[:, 8:14, 14:20].mean((1, 2))).round().int().tolist()
    assert table[2]["color"] == "#{:02x}{:02x}{:02x}".format(*mean)
    assert "24 pixels, one at" in kcgs("info", "scene.safetensors").out


@pytest.mark.parametrize("fill", [True, False])
def test_edits_are_those_of_python_in_a_fixed_order(kcgs: Kcgs, scene: Scene, fill: bool) -> None:
    options = () if fill else ("--no-fill",)
    code, out, err = kcgs("edit", "scene.safetensors", *EDITS, *options, "-o", "new.safetensors", "--json")
    assert code == 0, err
    expected = editing.move_region(editing.delete_region(scene, 3, fill=fill), 7, (-3, 1), fill=fill)
    assert torch.equal(load("new.safetensors").render(), expected.render())
    report = json.loads(out)
    assert (report["num_gaussians"], report["regions"]) == (expected.num_gaussians, 2)


def test_batch(kcgs: Kcgs, scene: Scene) -> None:
    assert kcgs("edit", "batch.safetensors", *EDITS, "-o", "new.safetensors").code == 0
    expected = video.move_in_video(video.delete_from_video(load("batch.safetensors"), 3), 7, (-3, 1))
    assert torch.equal(load("new.safetensors").render(), expected.render())


def test_recolor(kcgs: Kcgs, scene: Scene) -> None:
    code, _, err = kcgs("edit", "batch.safetensors", "--recolor", "7=#0000ff", "-o", "new.safetensors")
    assert code == 0, err
    expected = editing.recolor_region(load("batch.safetensors"), 7, color="#0000ff")
    assert torch.equal(load("new.safetensors").render(), expected.render())


def test_compressed_file(kcgs: Kcgs, scene: Scene) -> None:
    assert kcgs("edit", "scene.safetensors", "--delete", "3", "--delete", "7", "--no-fill", "-o", "new.kcgs").code == 0
    assert load("new.kcgs").regions is None


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "needs --delete, --recolor or --move"),
        (("--delete", "5"), "'--delete': must be among the 3 ids of the map, 0, 3, 7; got 5"),
        (("--delete", "3", "--move", "3=1,1"), "'--move': must be among the 2 ids of the map, 0, 7; got 3"),
        (("--move", "3=1"), "'--move': must be ID=DX,DY in pixels, such as 1=40,0; got '3=1'"),
        (("--move", "3=0.5,0"), "'--move': must be whole multiples of 1 pixel"),
        (("--recolor", "#ff0000"), "'--recolor': must be ID=COLOR, such as 2=#ff0000; got '#ff0000'"),
        (("--recolor", "3=reddish"), "'--recolor': must be a name such as red or #ff0000; got 'reddish'"),
        (("--recolor", "3=#ff0000", "--no-fill"), "'--no-fill': must be left out with --recolor alone"),
    ],
)
def test_wrong_usage(kcgs: Kcgs, scene: Scene, arguments: tuple[str, ...], words: str) -> None:
    code, _, err = kcgs("edit", "scene.safetensors", *arguments, "-o", "new.safetensors")
    assert code == 2 and words in err, err
    assert not Path("new.safetensors").exists()
