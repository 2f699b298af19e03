"""What the eye sees: a program that is or is not there, records that are completed, the worst crops."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from PIL import Image
from torch import Tensor

from benchmarks.core import eye, figures
from benchmarks.core.cases import UNCLAMPED, Case
from benchmarks.core.store import Store

IMAGE = torch.rand(3, 40, 48, generator=torch.Generator().manual_seed(0))


class Record(NamedTuple):
    ssimulacra2: float = math.nan
    butteraugli: float = math.nan


Program = Callable[[str], Path]


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Program:
    """Put a program in front of the PATH that keeps what it is given and prints a text."""

    def make(text: str) -> Path:
        folder = tmp_path / "bin"
        folder.mkdir()
        path = folder / eye.PROGRAM
        path.write_text(f'#!/bin/sh\ncp "$1" {folder}/first.png; cp "$2" {folder}/second.png; printf "{text}"\n')
        path.chmod(0o755)
        monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")
        return folder

    return make


@pytest.fixture
def nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(eye, "find_spec", lambda name: None)
    monkeypatch.setattr(eye.shutil, "which", lambda name: None)


class TestButteraugli:
    def test_reads_the_norm(self, program: Program) -> None:
        folder = program(r"3.2500000000\n3-norm: 1.250000\n")
        assert eye.butteraugli(IMAGE / 2, IMAGE) == 1.25
        # the reference comes first
        means = [torch.tensor(list(Image.open(folder / f"{name}.png").tobytes())).float().mean() / 255 for name in
                 ("first", "second")]  # fmt: skip
        assert means == pytest.approx([float(IMAGE.mean()), float(IMAGE.mean() / 2)], abs=0.01)

    def test_says_what_it_printed(self, program: Program) -> None:
        program("Failed to read image")
        with pytest.raises(RuntimeError, match=r"must print '3-norm: NUMBER'; got 'Failed to read image'"):
            eye.butteraugli(IMAGE, IMAGE)


class TestLook:
    def test_fills_in_what_is_missing(self, program: Program, monkeypatch: pytest.MonkeyPatch) -> None:
        pytest.importorskip("ssimulacra2", reason="SSIMULACRA2 needs the package ssimulacra2")
        assert eye.look(Record(butteraugli=1.0), lambda: (IMAGE, IMAGE)) == Record(100.0, 1.0)
        program(r"3-norm: 2.5\n")
        assert eye.look(Record(50.0), lambda: (IMAGE, IMAGE)) == Record(50.0, 2.5)

    def test_nothing_to_do(self, nothing: None) -> None:
        record = Record()
        assert eye.look(record, lambda: pytest.fail("no image is needed")) is record

    def test_rows_of_earlier_runs(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        store, case = Store(tmp_path, None), Case("disc", 5, UNCLAMPED, iterations=3, stride=8)
        store.make(case)
        path = store._path(case)
        kept = json.loads(path.read_text())
        path.write_text(json.dumps({**kept, "row": kept["row"][: -len(eye.MEASURES)]}))
        monkeypatch.setattr(eye, "find_spec", lambda name: True)
        monkeypatch.setitem(eye.MEASURES, "ssimulacra2", lambda render, image: 42.0)
        store.look(case)
        found = store.kept(case)
        assert found is not None and found.row.ssimulacra2 == 42.0 and found.row.psnr == kept["row"][5]
        store.look(case._replace(n=6))  # not made


class TestCrops:
    def test_the_worst(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        shown: list[Mapping[str, Tensor]] = []
        monkeypatch.setattr(figures, "plot_images", lambda path, *rows: shown.extend(rows))
        photo = torch.full((3, 300, 400), 0.5)
        bad = photo.clone()
        bad[:, :128, 256:384] += 0.3  # the worst, and the worst but one below it
        bad[:, 160:288, 0:128] += 0.2
        bad[:, 160:288, 256:384] += 0.1  # a third crop of this frame
        slight = photo.clone()
        slight[:, 16:144, 32:160] += 0.05
        frames: list[tuple[str, dict[str, Tensor]]] = [
            ("b", {"photo": photo, "ours": slight, "AVIF": photo}),
            ("a", {"photo": photo, "ours": bad, "AVIF": photo}),
        ]
        figures.plot_crops(tmp_path / "crops.png", frames)
        assert [list(row) for row in shown] == [
            ["a, x = 256, y = 0", "ours, 10.46 dB", "AVIF, inf dB"],
            ["a, x = 0, y = 160", "ours, 13.98 dB", "AVIF, inf dB"],
            ["b, x = 32, y = 16", "ours, 26.02 dB", "AVIF, inf dB"],
        ]
        assert all(crop.shape == (3, 128, 128) for row in shown for crop in row.values())

    def test_all_frames(self, tmp_path: Path) -> None:
        figures.save_sheet(tmp_path / "frames.jpg", [])
        assert not list(tmp_path.iterdir())
        narrow = {"photo": torch.zeros(3, 20, 30), "ours": torch.full((3, 20, 30), 2.0)}
        wide = {"photo": torch.full((3, 10, 40), 0.5), "ours": torch.zeros(3, 10, 40)}
        figures.save_sheet(tmp_path / "frames.jpg", [("narrow", narrow), ("wide", wide)])
        with Image.open(tmp_path / "frames.jpg") as sheet:
            assert sheet.size == (80, 30)
            expected = {(10, 10): 0, (45, 10): 255, (70, 10): 255, (20, 25): 128, (60, 25): 0}
            for place, level in expected.items():
                assert max(abs(c - level) for c in sheet.getpixel(place)) < 12  # type: ignore[arg-type, union-attr]

    def test_a_figure_where_there_are_any(self, tmp_path: Path) -> None:
        figures.plot_crops(tmp_path / figures.CROPS, [])
        assert figures.show_crops(tmp_path, "best") == []
        images: dict[str, Any] = {"photo": IMAGE, "best": IMAGE / 2}
        figures.plot_crops(tmp_path / figures.CROPS, [("noise", images)])
        text, link = figures.show_crops(tmp_path, "best")
        assert "`best`" in text and link == "![](crops.png)"
        with Image.open(tmp_path / figures.CROPS) as figure:
            assert figure.width > 400
