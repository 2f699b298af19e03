"""encode, decode and info of label maps."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from PIL import Image

from kcgs.data import load_labels, save_labels
from tests.cli.conftest import Kcgs
from tests.codec.conftest import make_labels


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    ("factor", "suffix", "mode"),
    [(1, "png", "P"), (300, "png", "I;16"), (70_000, "png", "RGB"), (1 << 40, "npy", "")],
)
def test_roundtrip(kcgs: Kcgs, factor: int, suffix: str, mode: str) -> None:
    labels = torch.from_numpy(make_labels(2)) * factor
    save_labels(f"mask.{suffix}", labels, rgb_ids=mode == "RGB")
    report = json.loads(kcgs("encode", f"mask.{suffix}", "-o", "mask.kcgs", "--json").out)
    assert report["bytes"] == Path("mask.kcgs").stat().st_size < 400
    assert (report["holds"], report["regions"], report["largest_id"]) == ("label map", 6, 5 * factor)
    assert json.loads(kcgs("info", "mask.kcgs", "--json").out) == report
    Path("mask.kcgs").rename("mask.other")  # the suffix does not matter
    kcgs("decode", "mask.other", "-o", f"decoded.{suffix.upper()}")
    assert torch.equal(load_labels(f"decoded.{suffix.upper()}", rgb_ids=True), labels)
    if mode:
        with Image.open("decoded.PNG") as image:
            assert image.mode == mode


def test_wrong_use(kcgs: Kcgs) -> None:
    save_labels("mask.png", torch.from_numpy(make_labels(2)))
    kcgs("encode", "mask.png", "-o", "mask.kcgs")
    Path("cut.kcgs").write_bytes(Path("mask.kcgs").read_bytes()[:-1])
    for command, code, message in (
        ("encode mask.png -o b.kcgs --quality 40", 2, "'--quality': must be left out with a label map"),
        ("decode mask.kcgs -o b.png --bytes 5", 2, "'--bytes': must be left out"),
        ("decode mask.kcgs -o b.jpg", 2, ".png or .npy"),
        ("encode mask.kcgs -o b.kcgs", 1, "kcgs decode writes it"),
        ("render mask.kcgs -o b.png", 1, "it is a label map, no scene"),
        ("info cut.kcgs", 1, "the file is damaged"),
        ("decode cut.kcgs -o b.png", 1, "the file is damaged"),
    ):
        run = kcgs(*command.split())
        assert run.code == code and message in run.err
    assert not Path("b.png").exists() and not Path("b.kcgs").exists()
