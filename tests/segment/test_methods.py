"""What every method promises, the registry, and that ``auto`` follows real objects."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import skimage.data
import torch
from torch import Tensor

from kcgs.data import chart_2x3, save_labels
from kcgs.errors import InvalidArgument, InvalidArgumentType
from kcgs.segment import (
    Cleanup,
    Prediction,
    available_methods,
    method_options,
    register,
    segment,
    segment_with_scores,
)
from kcgs.segment.methods import auto
from kcgs.segment.methods import objects as networks
from kcgs.segment.registry import _methods
from tests.segment.checks import assert_segmentation, split_image
from tests.segment.test_onnx import write_mixer

METHODS = ["auto", "chan_vese", "felzenszwalb", "kmeans", "quickshift", "slic", "watershed"]


def photo(name: str, step: int = 1) -> Tensor:
    return torch.from_numpy(getattr(skimage.data, name)()).permute(2, 0, 1).float()[:, ::step, ::step] / 255


@pytest.mark.parametrize("method", METHODS)
class TestEveryMethod:
    @pytest.mark.parametrize(("channels", "size"), [(1, (1, 1)), (3, (1, 40)), (1, (17, 31))])
    def test_small_images(self, method: str, size: tuple[int, int], channels: int) -> None:
        image = torch.rand(channels, *size, generator=torch.Generator().manual_seed(0))
        before = image.clone()
        result = segment_with_scores(image, method)
        assert_segmentation(result, size)
        assert torch.equal(image, before) and torch.equal(result.labels, segment(image.double(), method))

    def test_photo_and_options(self, method: str) -> None:
        image = photo("coffee", 4)
        result = segment_with_scores(image, method, min_size=500, max_regions=3)
        areas = result.labels.flatten().bincount()
        assert_segmentation(result, (100, 150))
        assert len(areas) <= 3 and areas.min() >= 500


def test_a_batch_is_its_images() -> None:
    images = torch.rand(2, 3, 17, 31, generator=torch.Generator().manual_seed(0))
    labels = segment(images, "slic", max_regions=3)
    assert torch.equal(labels, torch.stack([segment(image, "slic", max_regions=3) for image in images]))
    assert torch.equal(segment(images[:1], "slic", max_regions=3), labels[:1])


@pytest.mark.parametrize(
    ("image", "error", "message"),
    [
        ([0.5], TypeError, "image must be a Tensor, a numpy array, a PIL image or a path; got list"),
        (torch.zeros(2, 4, 4), ValueError, "image must have shape"),
        (torch.full((3, 4, 4), 255.0), ValueError, r"image must be in \[0, 1\]"),
    ],
)
def test_bad_image(image: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        segment(image)


@pytest.mark.parametrize(
    ("method", "options", "error"),
    [
        ("auto", {"max_regions": 0}, ValueError),
        ("auto", {"min_size": 2.5}, TypeError),
        ("auto", {"snap": -1}, ValueError),
        ("auto", {"connected": 1}, TypeError),
        ("felzenszwalb", {"scale": -1.0}, ValueError),
        ("slic", {"n_segments": 2.5}, TypeError),
        ("kmeans", {"num_clusters": 0}, ValueError),
        ("text", {"prompts": ["a"]}, ValueError),
    ],
)
def test_bad_option(method: str, options: dict[str, Any], error: type[Exception]) -> None:
    with pytest.raises(error, match=next(iter(options))):
        segment(torch.zeros(3, 4, 4), method, **options)


class TestRegistry:
    @pytest.fixture(autouse=True)
    def methods(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("kcgs.segment.registry._methods", dict(_methods))

    def test_names(self) -> None:
        assert {*METHODS, "dino", "file", "grabcut", "lseg", "onnx", "sam", "text"} <= set(available_methods())
        assert method_options("slic")["n_segments"] == 400

    def test_a_function_gets_the_image_and_its_cleanup(self) -> None:
        calls = []

        @register("test", Cleanup(snap=1), takes_cleanup=True)
        def halves(image: Tensor, *, power: float = 1.0, cleanup: Cleanup) -> Prediction:
            calls.append((image.dtype, tuple(image.shape), power, cleanup))
            labels = np.broadcast_to(np.arange(30) >= 10, (20, 30))
            return Prediction(labels, labels * 0.5 + 0.25, ["sky", "dog"])

        result = segment_with_scores(torch.zeros(1, 20, 30), "test", power=2.0, snap=0)
        assert calls == [(torch.float32, (3, 20, 30), 2.0, Cleanup())]
        assert next(iter(method_options("test"))) == "power" and "cleanup" not in method_options("test")
        assert result.scores is not None and result.scores.tolist() == [0.75, 0.25]
        assert result.names == {0: "dog", 1: "sky"}

    @pytest.mark.parametrize(
        ("result", "error", "message"),
        [
            (torch.full((4, 4), -1), ValueError, "labels must hold non-negative ids"),
            (torch.full((4, 4), 0.5), ValueError, "labels must hold whole numbers; got 0.5"),
            (torch.zeros(2, 2).long(), ValueError, "labels must have the image's size"),
            (Prediction(np.ones((4, 4), int), np.ones(3)), ValueError, "scores must have the image's size"),
            (Prediction(np.ones((4, 4), int), names=["sky"]), ValueError, "names must have one for label 1"),
        ],
    )
    def test_bad_results(self, result: Any, error: type[Exception], message: str) -> None:
        register("test")(lambda image: result)
        with pytest.raises(error, match=message):
            segment(torch.zeros(3, 4, 4), "test")

    def test_a_function_defined_again_replaces_itself(self) -> None:
        for threshold in (0.5, 2.0):
            register("test")(lambda image, limit=threshold: (image[0] > limit).long())
        assert segment(torch.eye(4)[None], "test", connected=False, min_size=1).unique().tolist() == [0]

    def test_errors(self) -> None:
        with pytest.raises(InvalidArgument, match="method must be one of auto, .*; got 'magic'"):
            segment(torch.zeros(3, 4, 4), "magic")
        with pytest.raises(InvalidArgumentType, match="option must be one of the method 'auto', .*; got 'colour'"):
            segment(torch.zeros(3, 4, 4), colour=3)
        for name in ("auto", ""):
            with pytest.raises(InvalidArgument, match="name must be a new name"):
                register(name)(lambda image: image[0] > 0.5)
        register("test")(lambda image, min_size=1: image[0] > 0.5)
        with pytest.raises(InvalidArgument, match=r"function must be without options of the clean-up.*'min_size'"):
            segment(torch.zeros(3, 4, 4), "test", min_size=2)


class TestAuto:
    def test_flat_image_and_chart(self) -> None:
        assert (segment(torch.full((3, 60, 80), 0.4)) == 0).all()
        chart = chart_2x3()
        labels = segment(chart.image)
        shared = (chart.labels * 6 + labels).flatten().bincount(minlength=36).reshape(6, 6)
        assert int(labels.max()) == 5 and shared.amax(1).sum() > 0.999 * labels.numel()

    def test_photo(self) -> None:
        result = segment_with_scores(photo("coffee"))
        labels = result.labels
        assert_segmentation(result, (400, 600))
        assert 4 <= int(labels.max()) + 1 <= 30
        assert len({int(labels[point]) for point in ((30, 40), (130, 290), (50, 300), (330, 420), (200, 560))}) == 5

    @pytest.mark.parametrize("large", [1000, 10**9])
    def test_regions_never_cross_the_contours_of_objects(self, monkeypatch: pytest.MonkeyPatch, large: int) -> None:
        monkeypatch.setattr(auto, "_LARGE", large)
        monkeypatch.setattr(auto, "_MAX_PIXELS", 5_000)
        image, y, x = photo("coffee", 4), torch.arange(100)[:, None], torch.arange(150)  # cut at a smaller size
        objects = 7 * ((y - 50) ** 2 + (x - 75) ** 2 < 30**2).long()  # a disc across cup, saucer and table
        objects[:3, :3] = 9  # too small
        result = segment_with_scores(image, objects=objects, max_regions=None)
        assert_segmentation(result, (100, 150))
        assert result.names is not None and set(result.names.values()) == {"0", "7"}
        inside = torch.tensor([region for region, name in result.names.items() if name == "7"])
        assert len(inside) > 1 and torch.equal(torch.isin(result.labels, inside), objects == 7)
        few = segment_with_scores(image, objects=objects, max_regions=2)
        assert torch.equal(few.labels == 1, objects == 7) and few.names == {0: "0", 1: "7"}

    def test_objects_of_a_flat_image(self) -> None:
        objects = torch.zeros(60, 80, dtype=torch.bool)
        objects[10:40, 20:50] = True
        assert torch.equal(segment(torch.full((3, 60, 80), 0.4), objects=objects) == 1, objects)

    def test_the_main_object(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        image = split_image(40, 60, 25)
        image[:, 20:, 40:] = 1.0  # not blue, so not the object's
        network = write_mixer(tmp_path / "net.onnx", [[-4.0, -4.0, 8.0]])
        weights = networks._WEIGHTS["isnet-general-use"]
        monkeypatch.setattr(networks, "_find_weights", lambda model: (network, weights))
        labels, _, names = segment_with_scores(image, objects="object")
        assert names == {0: "background", 1: "object", 2: "background"}
        assert torch.equal(labels == 1, (image[2] > 0) & (image[0] == 0))

    def test_bad_objects(self) -> None:
        halves = (torch.arange(80) > 40).expand(60, 80)
        with pytest.raises(ValueError, match="max_regions must be at least 2, the number of pieces of objects; got 1"):
            segment(torch.rand(3, 60, 80), objects=halves, max_regions=1)
        with pytest.raises(ValueError, match="snap must be 0 with objects"):
            segment(torch.rand(3, 60, 80), objects=halves, snap=2)
        with pytest.raises(ValueError, match=r"objects must be of the image's size \(60, 80\); got \(6, 8\)"):
            segment(torch.rand(3, 60, 80), objects=torch.zeros(6, 8, dtype=torch.int64))
        with pytest.raises(TypeError, match="objects must be"):
            segment(torch.rand(3, 60, 80), objects=3.0)


def test_file_stays_as_it_is(tmp_path: Path) -> None:
    mask = (torch.arange(30) >= 12).long().repeat(20, 1) * 255
    mask[3, 2] = 255
    save_labels(tmp_path / "mask.png", mask)
    assert torch.equal(segment(torch.zeros(3, 20, 30), "file", path=tmp_path / "mask.png"), (mask == 0).long())
