"""`kcgs segment`, and the warning about masks that do not belong to their image."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
import torch
from torch import Tensor

from kcgs.cli import main
from kcgs.data import load_image, load_labels, overlay_labels, save_image, save_labels
from kcgs.fitting.kmeans import kmeans_field
from kcgs.functional import RegionMap
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
        arguments = ("segment", "photo.png", "-o", "out.png", "--method", method, "--max-regions", "2", "--json")
        code, out, err = kcgs(*arguments, capsys=capsys, monkeypatch=monkeypatch)
        assert code == 0, err
        report = json.loads(out)
        labels = load_labels("out.png")
        assert report["regions"] == len(labels.unique()) == 2
        assert report["method"] == method
        rows = report["table"]
        keys = {"id", "name", "area", "share", "edge_alignment", "gaussian_share", "score"}
        assert [set(row) for row in rows] == [keys] * 2
        assert {(row["name"], row["score"]) for row in rows} == {(None, None)}
        assert sum(row["gaussian_share"] for row in rows) == pytest.approx(1)
        assert [row["area"] for row in rows] == labels.flatten().bincount().tolist()
        assert sum(row["share"] for row in rows) == pytest.approx(1)
        assert report["edge_alignment"] > 0.9 and all(row["edge_alignment"] > 0.9 for row in rows)

    def test_options_are_json_or_text(
        self, files: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        options = ("--option", "sigma=0.0", "--option", "num_clusters=2", "--option", "snap=0")
        arguments = ("segment", "photo.png", "-o", "out.npy", "--method", "kmeans", *options)
        code, out, err = kcgs(*arguments, capsys=capsys, monkeypatch=monkeypatch)
        assert code == 0, err
        assert torch.equal(load_labels("out.npy"), load_labels("mask.png"))
        assert "edge alignment" in out and "84.4%" in out
        arguments = ("segment", "photo.png", "-o", "out.npy", "--method", "file", "--option", "path=mask.png")
        code, _, err = kcgs(*arguments, capsys=capsys, monkeypatch=monkeypatch)
        assert code == 0, err

    def test_share_of_gaussians_is_what_a_fit_starts_with(
        self, files: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        image = load_image("photo.png")
        image[:, 12:36, 8:28] += 0.1 * torch.rand(24, 20, generator=torch.Generator().manual_seed(0)) - 0.1
        save_image("photo.png", image)
        arguments = ("segment", "photo.png", "-o", "out.png", "--method", "file", "--option", "path=mask.png")
        _, out, _ = kcgs(*arguments, "--json", capsys=capsys, monkeypatch=monkeypatch)
        shares = [row["gaussian_share"] for row in json.loads(out)["table"]]
        regions = RegionMap.from_labels(load_labels("out.png"))
        field = kmeans_field(load_image("photo.png"), 1000, regions, seed=0)
        assert field.region_ids is not None
        assert field.region_ids.bincount().tolist() == pytest.approx([1000 * share for share in shares], abs=1)
        assert shares[1] > 0.5  # all detail is in the smaller region
        _, out, _ = kcgs(*arguments, capsys=capsys, monkeypatch=monkeypatch)
        assert "share of Gaussians" in out and f"{shares[1]:.1%}" in out
        assert "score" not in out and "name" not in out

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

    def test_one_region_has_no_alignment(
        self, files: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        arguments = ("segment", "photo.png", "-o", "out.png", "--max-regions", "1")
        code, out, _ = kcgs(*arguments, "--json", capsys=capsys, monkeypatch=monkeypatch)
        report = json.loads(out)
        assert code == 0
        assert report["edge_alignment"] is None and report["table"][0]["edge_alignment"] is None
        assert kcgs(*arguments, capsys=capsys, monkeypatch=monkeypatch)[0] == 0

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
            (("--option", "max_regions=many"), 2, "--max-regions must be an integer; got 'many'"),
            (("--option", "nonsense"), 2, "--option must be KEY=VALUE; got 'nonsense'"),
            (("--option", "a=1", "--option", "a=2"), 2, "--option a is given twice"),
            (("--max-regions", "0"), 2, "greater than or equal to 1"),
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
    assert code == 0 and "\nfelzenszwalb: scale=300.0, sigma=1.0, snap=0, min_size=None, connected=True" in out
    assert [line.partition(":")[0] for line in out.splitlines()] == available_methods()


class TestWarning:
    @pytest.mark.filterwarnings("default")
    @pytest.mark.parametrize(("mask", "warned"), [("mask.png", 0), ("mirrored.png", 1)])
    def test_fit_warns_of_a_mask_beside_the_edges(
        self, files: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, mask: str, warned: int
    ) -> None:
        arguments = ("fit", "photo.png", "-n", "4", "--iterations", "2", "--regions", mask, "-o", "scene.safetensors")
        code, _, err = kcgs(*arguments, capsys=capsys, monkeypatch=monkeypatch)
        assert code == 0, err
        assert err.count("hardly follow the image's edges: alignment 0.") == warned


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
