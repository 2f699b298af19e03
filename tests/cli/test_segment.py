"""`kcgs segment`."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
import torch
from torch import Tensor

from kcgs.cli import main
from kcgs.data import load_image, load_labels, overlay_labels, save_image, save_labels
from kcgs.segment import Prediction, available_methods, register
from kcgs.segment.registry import _methods


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    labels = torch.zeros(48, 64, dtype=torch.long)
    labels[12:36, 8:28] = 1
    save_image("photo.png", torch.where(labels.bool(), torch.tensor([0.9, 0.4, 0.1])[:, None, None], 0.3))
    save_labels("mask.png", labels)
    save_labels("mirrored.png", labels.flip(1))
    return tmp_path


def kcgs(*arguments: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> tuple[int, str, str]:
    monkeypatch.setattr(sys, "argv", ["kcgs", *arguments])
    code = 0
    try:
        main()
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    captured = capsys.readouterr()
    return code, captured.out, captured.err


class TestSegment:
    @pytest.mark.parametrize("method", ["auto", "felzenszwalb", "slic", "watershed", "kmeans"])
    def test_methods_and_table(
        self, files: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, method: str
    ) -> None:
        arguments = ("segment", "photo.png", "-o", "out.png", "--method", method, "--option", "max_regions=2", "--json")
        code, out, err = kcgs(*arguments, capsys=capsys, monkeypatch=monkeypatch)
        assert code == 0, err
        report = json.loads(out)
        labels = load_labels("out.png")
        assert report["regions"] == len(labels.unique()) == 2
        assert report["method"] == method
        rows = report["table"]
        keys = {"id", "name", "area", "score"}
        assert [set(row) for row in rows] == [keys] * 2
        assert {(row["name"], row["score"]) for row in rows} == {(None, None)}
        assert [row["area"] for row in rows] == labels.flatten().bincount().tolist()

    def test_options_are_json_or_text(
        self, files: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        options = ("--option", "sigma=0.0", "--option", "num_clusters=2", "--option", "snap=0")
        arguments = ("segment", "photo.png", "-o", "out.npy", "--method", "kmeans", *options)
        code, out, err = kcgs(*arguments, capsys=capsys, monkeypatch=monkeypatch)
        assert code == 0, err
        assert torch.equal(load_labels("out.npy"), load_labels("mask.png"))
        assert "480 pixels" in out
        arguments = ("segment", "photo.png", "-o", "out.npy", "--method", "file", "--option", "path=mask.png")
        code, _, err = kcgs(*arguments, capsys=capsys, monkeypatch=monkeypatch)
        assert code == 0, err

    def test_names_and_scores(
        self, files: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def named(image: Tensor, *, classes: list[str]) -> Prediction:
            labels = load_labels("mask.png")
            return Prediction(labels, torch.where(labels > 0, 0.75, float("nan")), classes)

        monkeypatch.setattr("kcgs.segment.registry._methods", dict(_methods))
        register("named")(named)
        arguments = ("segment", "photo.png", "-o", "out.png", "--method", "named")
        arguments += ("--option", 'classes=["the wall", "a [red] door"]')
        _, out, _ = kcgs(*arguments, "--json", capsys=capsys, monkeypatch=monkeypatch)
        rows = json.loads(out)["table"]
        assert [(row["name"], row["score"]) for row in rows] == [("the wall", None), ("a [red] door", 0.75)]
        _, out, _ = kcgs(*arguments, capsys=capsys, monkeypatch=monkeypatch)
        assert "the wall" in out and "a [red] door" in out and "0.75" in out and "nan" not in out

    def test_overlay(self, files: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
        arguments = ("segment", "photo.png", "-o", "out.png", "--overlay", "over.png")
        assert kcgs(*arguments, capsys=capsys, monkeypatch=monkeypatch)[0] == 0
        expected = overlay_labels(load_image("photo.png"), load_labels("out.png"))
        assert (load_image("over.png") - expected).abs().max() <= 0.5 / 255 + 1e-6

    @pytest.mark.parametrize(
        ("arguments", "code", "words"),
        [
            (("--method", "magic"), 2, "--method must be one of"),
            (("--option", "colour=3"), 2, "--option must be one of the method 'auto'"),
            (("--option", "max_regions=many"), 1, "max_regions must be an integer; got 'many'"),
            (("--option", "nonsense"), 2, "--option must be KEY=VALUE; got 'nonsense'"),
            (("--overlay", "over.txt"), 2, "--overlay must end in .png"),
        ],
    )
    def test_errors(
        self,
        files: Path,
        capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch,
        arguments: tuple[str, ...],
        code: int,
        words: str,
    ) -> None:
        got, _, err = kcgs("segment", "photo.png", "-o", "out.png", *arguments, capsys=capsys, monkeypatch=monkeypatch)
        assert got == code
        assert words in " ".join(err.replace("│", " ").split())
        if code == 1:
            assert err.startswith("kcgs: ") and err.count("\n") == 1
        assert not Path("out.png").exists()


def test_methods_and_their_options_are_listed(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    code, out, _ = kcgs("segment", "--methods", capsys=capsys, monkeypatch=monkeypatch)
    assert code == 0 and "\nfelzenszwalb: scale=300.0, sigma=1.0, channel_axis=-1, snap=0, min_size=None" in out
    assert [line.partition(":")[0] for line in out.splitlines()] == available_methods()


class TestOverlay:
    def test_neighbours_differ_and_contours_show(self) -> None:
        labels = torch.arange(6).view(2, 3).repeat_interleave(20, 0).repeat_interleave(20, 1) * 5
        overlay = overlay_labels(torch.full((1, 40, 60), 0.5), labels)
        assert overlay.shape == (3, 40, 60)
        inside = overlay[:, 10::20, 10::20]
        assert (inside[:, 0] != inside[:, 1]).any(0).all() and (inside[:, :, 1:] != inside[:, :, :-1]).any(0).all()
        assert (overlay == 1).all(0).any() and (overlay == 0).all(0).any()

    def test_size_must_fit(self) -> None:
        with pytest.raises(ValueError, match="image must have shape"):
            overlay_labels(torch.zeros(3, 4, 4), torch.zeros(4, 5).long())
