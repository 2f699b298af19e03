"""`kcgs segment`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from torch import Tensor

from kcgs.data import load_image, load_labels, overlay_labels
from kcgs.segment import Prediction, available_methods, register
from kcgs.segment.registry import _methods
from tests.cli.conftest import Kcgs

SEGMENT = ("segment", "photo.png", "-o", "out.png")


@pytest.mark.usefixtures("photo")
class TestSegment:
    def test_table(self, kcgs: Kcgs) -> None:
        arguments = ("--method", "slic", "--option", "max_regions=2", "--overlay", "over.png", "--json")
        report, labels = json.loads(kcgs(*SEGMENT, *arguments).out), load_labels("out.png")
        areas = labels.flatten().bincount().tolist()
        table = [{"id": region, "area": area, "name": None, "score": None} for region, area in enumerate(areas)]
        assert report == {"regions": 2, "method": "slic", "table": table}
        expected = overlay_labels(load_image("photo.png"), labels, ids=True)
        assert (load_image("over.png") - expected).abs().max() <= 0.5 / 255 + 1e-6

    def test_options_are_json_or_text(self, kcgs: Kcgs) -> None:
        options = ("--option", "sigma=0.0", "--option", "num_clusters=2", "--option", "snap=0")
        assert "500 pixels" in kcgs("segment", "photo.png", "-o", "out.npy", "--method", "kmeans", *options).out
        assert torch.equal(load_labels("out.npy"), load_labels("mask.png"))
        assert kcgs(*SEGMENT, "--method", "file", "--option", "path=mask.png").code == 0

    def test_names_and_scores(self, kcgs: Kcgs, monkeypatch: pytest.MonkeyPatch) -> None:
        def segment_by_mask(image: Tensor, *, classes: list[str]) -> Prediction:
            labels = load_labels("mask.png")
            return Prediction(labels, torch.where(labels > 0, 0.75, float("nan")), classes)

        monkeypatch.setattr("kcgs.segment.registry._methods", dict(_methods))
        register("mask")(segment_by_mask)
        arguments = (*SEGMENT, "--method", "mask", "--option", 'classes=["the wall", "a [red] door"]')
        rows = json.loads(kcgs(*arguments, "--json").out)["table"]
        assert [(row["name"], row["score"]) for row in rows] == [("the wall", None), ("a [red] door", 0.75)]
        out = kcgs(*arguments).out
        assert "the wall" in out and "a [red] door" in out and "0.75" in out and "nan" not in out

    def test_a_box_and_clicks(self, kcgs: Kcgs) -> None:
        pytest.importorskip("cv2", reason="needs the extra: pip install opencv-python-headless")
        arguments = ("--method", "grabcut", "--box", "15,6,50,34", "--foreground", "30,20", "--background", "5,5")
        run = kcgs(*SEGMENT, *arguments)
        assert run.code == 0 and " pixels, object" in run.out and " pixels, background" in run.out
        assert (load_labels("out.png") == load_labels("mask.png")).float().mean() > 0.99

    @pytest.mark.parametrize(
        ("arguments", "code", "words"),
        [
            (("--option", "colour=3"), 2, "'--option': must be one of the method 'auto'"),
            (("--option", "max_regions=many"), 1, "kcgs: max_regions must be an integer; got 'many'"),
            (("--option", "nonsense"), 2, "'--option': must be KEY=VALUE; got 'nonsense'"),
            (("--method", "grabcut"), 2, "'--box': must be given for the method 'grabcut'"),
            (("--method", "grabcut", "--box", "1,2,3"), 2, "'--box': must be X0,Y0,X1,Y1 in pixels; got '1,2,3'"),
            (("--method", "sam", "--background", "1"), 2, "'--background': must be X,Y in pixels; got '1'"),
            (("--box", "1,2,3,4"), 2, "'--option': must be one of the method 'auto'"),
            (("--overlay", "over.txt"), 2, "'--overlay': must end in .png"),
        ],
    )
    def test_errors(self, kcgs: Kcgs, arguments: tuple[str, ...], code: int, words: str) -> None:
        run = kcgs(*SEGMENT, *arguments)
        assert run.code == code and words in run.err and not Path("out.png").exists()


def test_methods_and_their_options_are_listed(kcgs: Kcgs) -> None:
    out = kcgs("segment", "--methods").out
    assert "\nfelzenszwalb: scale=300.0, sigma=1.0, channel_axis=-1, snap=0, min_size=None" in out
    assert [line.partition(":")[0] for line in out.splitlines()] == available_methods()
