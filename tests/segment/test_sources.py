"""What the sources share, and maps that exist already: masks on disk, DAVIS."""

import inspect
import sys
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest
import torch
from torch import Tensor

from kcgs.data import Davis, save_image, save_labels
from kcgs.segment import (
    Cleanup,
    Prediction,
    Segmentation,
    available_methods,
    register,
    sam,
    segment,
    segment_with_scores,
)
from kcgs.segment.methods.onnx_networks import read_names
from kcgs.segment.registry import _methods


def two_colors(height: int = 20, width: int = 30, split: int = 10) -> Tensor:
    image = torch.zeros(3, height, width)
    image[..., split:] = 1.0
    return image


def clean(labels: Tensor, scores: Tensor | None = None, names: list[str] | None = None, **options: Any) -> Segmentation:
    return Cleanup(**options).apply(two_colors(), Prediction(labels, scores, names))


class TestRegistry:
    def test_methods(self) -> None:
        assert {"sam", "dino", "text", "lseg", "onnx", "file", "davis"} <= set(available_methods())

    def test_a_method_without_scores(self) -> None:
        labels, scores, _ = segment_with_scores(two_colors(), "felzenszwalb", sigma=0.0)
        assert scores is None
        assert torch.equal(labels, segment(two_colors(), "felzenszwalb", sigma=0.0))

    def test_unknown_method(self) -> None:
        with pytest.raises(ValueError, match="method must be one of"):
            segment_with_scores(two_colors(), "magic")

    def test_scored_and_plain_agree(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("kcgs.segment.registry._methods", dict(_methods))

        @register("test", Cleanup(min_size=1))
        def halves(image: Tensor) -> Prediction:
            labels = (torch.arange(image.shape[-1]) >= 10).long().expand(image.shape[-2:])
            return Prediction(labels, labels * 0.5 + 0.25)

        labels, scores, _ = segment_with_scores(two_colors(), "test")
        assert torch.equal(labels, segment(two_colors(), "test"))
        assert torch.equal(labels, halves(two_colors()))
        assert scores is not None
        assert scores.tolist() == [0.75, 0.25]  # The larger right side comes first.
        with pytest.raises(ValueError, match="already"):
            register("test")

    def test_method_gets_a_checked_image_and_the_cleanup_that_follows(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("kcgs.segment.registry._methods", dict(_methods))
        seen = []

        @register("test", Cleanup(max_regions=7))
        def whole(image: Tensor, *, power: float = 1.0, min_size: int, max_regions: int | None) -> Tensor:
            seen.append((image.dtype, tuple(image.shape), power, min_size, max_regions))
            return torch.zeros(image.shape[1:], dtype=torch.int64)

        gray = torch.full((1, 20, 30), 0.5, dtype=torch.float64, requires_grad=True)
        assert int(segment(gray, "test").max()) == 0
        segment(gray, "test", power=2.0, min_size=9, max_regions=None)
        assert seen == [(torch.float32, (3, 20, 30), 1.0, 24, 7), (torch.float32, (3, 20, 30), 2.0, 9, None)]
        assert list(inspect.signature(whole).parameters) == [
            "image", "power", "snap", "min_size", "connected", "max_regions"
        ]  # fmt: skip

    def test_labels_of_another_size(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("kcgs.segment.registry._methods", dict(_methods))
        register("test")(lambda image: torch.zeros(2, 2, dtype=torch.int64))
        with pytest.raises(ValueError, match=r"method 'test' must have the image's size \(20, 30\); got \(2, 2\)"):
            segment(two_colors(), "test")

    @pytest.mark.parametrize(
        "labels",
        [
            lambda columns: columns >= 10,
            lambda columns: (columns >= 10).half(),
            lambda columns: (columns >= 10).double().numpy(),
            lambda columns: (columns >= 10).numpy().astype("uint16")[:, ::-1],
            lambda columns: ((columns >= 10) * 2**40 + 7).expand(20, 30).T.contiguous().T,
        ],
    )
    def test_labels_of_other_kinds(self, monkeypatch: pytest.MonkeyPatch, labels: Any) -> None:
        monkeypatch.setattr("kcgs.segment.registry._methods", dict(_methods))
        register("test")(lambda image: labels(torch.arange(30).expand(20, 30)))
        found = segment(two_colors(), "test")
        assert found.dtype == torch.int64 and found.shape == (20, 30)
        assert found.flatten().bincount().tolist() == [400, 200]  # by area

    @pytest.mark.parametrize(
        ("labels", "error", "message"),
        [
            (torch.full((20, 30), -1), ValueError, "must be non-negative; got -1: give pixels of no region an id"),
            (torch.full((20, 30), 0.5), ValueError, "labels from segmentation method 'test' must be whole numbers"),
            (torch.full((20, 30), torch.nan), ValueError, "must be whole numbers; got torch.float32"),
            (torch.zeros(20, 30, 1), ValueError, r"must have the image's size \(20, 30\); got \(20, 30, 1\)"),
            (np.full((20, 30), "sky"), TypeError, "must be a Tensor or a numpy array of numbers; got an array of <U3"),
            ([[0]], TypeError, "must be a Tensor or a numpy array of numbers; got list"),
            (Prediction(np.ones((20, 30)), names=["sky"]), ValueError, "must say what label 1 is; got 1 names"),
            (Prediction(np.ones((20, 30)), np.ones(3)), ValueError, "scores from .* must have the image's size"),
        ],
    )
    def test_labels_that_are_none(
        self, monkeypatch: pytest.MonkeyPatch, labels: Any, error: type[Exception], message: str
    ) -> None:
        monkeypatch.setattr("kcgs.segment.registry._methods", dict(_methods))
        register("test")(lambda image: labels)
        with pytest.raises(error, match=message):
            segment(two_colors(), "test")

    def test_images_of_other_kinds(self) -> None:
        pixels = (two_colors().permute(1, 2, 0) * 255).byte().numpy()
        for image in (pixels, PIL.Image.fromarray(pixels), two_colors()[None], pixels[..., 0]):
            assert torch.equal(segment(image, "kmeans"), segment(two_colors(), "kmeans"))

    def test_signature_says_what_is_returned(self) -> None:
        signature = inspect.signature(sam)
        assert signature.return_annotation is Tensor
        assert {"checkpoint", "snap", "min_size", "connected", "max_regions"} <= set(signature.parameters)

    @pytest.mark.parametrize(
        ("method", "library", "options", "line"),
        [
            ("dino", "transformers", {"model": "some/model"}, r"pip install 'kcgs\[segment\]'"),
            ("text", "transformers", {"model": "some/model", "prompts": ["a", "b"]}, r"pip install 'kcgs\[segment\]'"),
            ("sam", "transformers", {"model": "some/model"}, r"pip install 'kcgs\[segment\]'"),
            ("sam", "kornia.models.sam.model", {}, "pip install kornia"),
            ("onnx", "onnxruntime", {"model": "net.onnx"}, "pip install onnxruntime"),
            ("auto", "skimage.segmentation", {}, "pip install scikit-image"),
            ("slic", "skimage.segmentation", {}, "pip install scikit-image"),
            ("watershed", "skimage.color", {}, "pip install scikit-image"),
            ("kmeans", "scipy.cluster.vq", {}, "pip install scipy"),
        ],
    )
    def test_method_says_what_to_install(
        self, monkeypatch: pytest.MonkeyPatch, method: str, library: str, options: dict[str, Any], line: str
    ) -> None:
        monkeypatch.setitem(sys.modules, library, None)
        with pytest.raises(ImportError, match=f"segmentation method '{method}' needs .*{line}"):
            segment(two_colors(), method, **options)
        with pytest.raises(ImportError, match=line):
            segment_with_scores(two_colors(), method, **options)


class TestNames:
    def test_a_region_is_called_as_most_of_it(self) -> None:
        classes = (torch.arange(30) >= 12).long().repeat(20, 1) * 2
        classes[:, 28:] = 0
        classes[5, 20] = 1
        found = clean(classes, names=["sky", "bird", "dog"])
        assert found.names == {0: "dog", 1: "sky", 2: "sky"}  # The bird was a speck; sky is in two pieces.
        merged = clean(classes, names=["sky", "bird", "dog"], max_regions=1)
        assert merged.names == {0: "dog"}
        assert clean(classes).names is None

    def test_file(self, tmp_path: Path) -> None:
        path = tmp_path / "names.txt"
        path.write_text("sky\n\nzweite Möwe \n\n", encoding="utf-8")
        assert read_names(path) == read_names(str(path)) == ["sky", "", "zweite Möwe"]
        assert read_names(None) is None

    def test_errors(self, tmp_path: Path) -> None:
        with pytest.raises(FileNotFoundError, match=r"no names of classes at .*gone.txt"):
            read_names(tmp_path / "gone.txt")
        (tmp_path / "bad.txt").write_bytes(b"\xff\xfe\x00")
        with pytest.raises(ValueError, match=r"cannot read .*bad.txt as UTF-8"):
            read_names(tmp_path / "bad.txt")
        (tmp_path / "empty.txt").write_text("")
        for empty in ([], tmp_path / "empty.txt"):
            with pytest.raises(ValueError, match="at least one name"):
                read_names(empty)
        for wrong in (["sky", 3], 5):
            with pytest.raises(TypeError, match="names must be a list of strings"):
                read_names(wrong)  # type: ignore[arg-type]


class TestCleanup:
    def labels(self) -> Tensor:
        labels = (torch.arange(30) >= 12).long().repeat(20, 1)
        labels[5, 20] = 7
        labels[:, 28:] = 0
        return labels

    def test_defaults(self) -> None:
        result, scores, _ = clean(self.labels())
        assert scores is None
        assert result.flatten().bincount().tolist() == [320, 240, 40]  # The speck is gone, the right margin a region.

    def test_nothing(self) -> None:
        result = clean(self.labels(), min_size=1, connected=False).labels
        assert result.flatten().bincount().tolist() == [319, 280, 1]

    def test_contours_snap(self) -> None:
        result = clean((torch.arange(30) >= 12).long().repeat(20, 1), snap=3).labels
        assert torch.equal(result, (torch.arange(30) < 10).long().repeat(20, 1))

    def test_budget(self) -> None:
        result = clean(self.labels(), max_regions=2).labels
        assert int(result.max()) + 1 == 2

    def test_scores_are_means_of_what_is_known(self) -> None:
        painted = torch.full((20, 30), float("nan"))
        painted[:10, :12] = 0.5
        painted[10:, :6] = 0.9
        _, scores, _ = clean(self.labels(), painted)
        assert scores is not None
        assert scores.isnan().tolist() == [True, False, True]
        assert float(scores[1]) == pytest.approx((120 * 0.5 + 60 * 0.9) / 180)

    @pytest.mark.parametrize(
        ("options", "error"),
        [
            ({"min_size": 0}, ValueError),
            ({"min_size": 1.5}, TypeError),
            ({"snap": -1}, ValueError),
            ({"snap": True}, TypeError),
            ({"max_regions": 0}, ValueError),
            ({"connected": 1}, TypeError),
        ],
    )
    def test_bad_option(self, options: dict[str, Any], error: type[Exception]) -> None:
        with pytest.raises(error, match=rf"{next(iter(options))} must be .*got"):
            Cleanup(**options)


class TestFile:
    def test_map_stays_as_it_is(self, tmp_path: Path) -> None:
        mask = (torch.arange(30) >= 12).long().repeat(20, 1) * 255
        mask[3, 2] = 255
        save_labels(tmp_path / "mask.png", mask)
        assert torch.equal(segment(two_colors(), "file", path=tmp_path / "mask.png"), (mask == 0).long())

    def test_cleaned_if_asked(self, tmp_path: Path) -> None:
        mask = (torch.arange(30) >= 12).long().repeat(20, 1)
        mask[3, 2] = 1
        save_labels(tmp_path / "mask.npy", mask)
        labels = segment(two_colors(), "file", path=tmp_path / "mask.npy", min_size=2, snap=2)
        assert torch.equal(labels, (torch.arange(30) < 10).long().repeat(20, 1))

    def test_other_size(self, tmp_path: Path) -> None:
        save_labels(tmp_path / "mask.png", torch.zeros(4, 5, dtype=torch.int64))
        with pytest.raises(ValueError, match=r"'file' must have the image's size \(20, 30\); got \(4, 5\)"):
            segment(two_colors(), "file", path=tmp_path / "mask.png")

    def test_missing_and_unreadable(self, tmp_path: Path) -> None:
        with pytest.raises(FileNotFoundError, match=r"gone.png"):
            segment(two_colors(), "file", path=tmp_path / "gone.png")
        (tmp_path / "bad.png").write_bytes(b"no image")
        with pytest.raises(ValueError, match=r"bad.png"):
            segment(two_colors(), "file", path=tmp_path / "bad.png")

    def test_unknown_option(self, tmp_path: Path) -> None:
        save_labels(tmp_path / "mask.png", torch.zeros(20, 30, dtype=torch.int64))
        with pytest.raises(TypeError, match="colour"):
            segment(two_colors(), "file", path=tmp_path / "mask.png", colour=1)


class TestDavis:
    def make(self, root: Path) -> None:
        for tree in ("JPEGImages", "Annotations"):
            (root / tree / "480p" / "cows").mkdir(parents=True)
        save_image(root / "JPEGImages/480p/cows/00000.jpg", two_colors())
        save_labels(root / "Annotations/480p/cows/00000.png", (torch.arange(30) < 9).long().repeat(20, 1))

    def test_annotation(self, tmp_path: Path) -> None:
        self.make(tmp_path)
        labels = segment(two_colors(), "davis", root=tmp_path, sequence="cows")
        assert torch.equal(labels, (torch.arange(30) < 9).long().repeat(20, 1))

    def test_errors(self, tmp_path: Path) -> None:
        self.make(tmp_path)
        with pytest.raises(ValueError, match="sequences must be among cows; got 'dogs'"):
            segment(two_colors(), "davis", root=tmp_path, sequence="dogs")
        with pytest.raises(ValueError, match=r"'davis' must have the image's size \(21, 30\); got \(20, 30\)"):
            segment(two_colors(21), "davis", root=tmp_path, sequence="cows")
        with pytest.raises(FileNotFoundError):
            segment(two_colors(), "davis", root=tmp_path / "gone", sequence="cows")

    def test_real_frame(self, data_root: Path) -> None:
        if not (data_root / "DAVIS").is_dir():
            pytest.skip(f"no DAVIS in {data_root}")
        frame = Davis(data_root / "DAVIS")["cows"]
        labels = segment(frame.image, "davis", root=data_root / "DAVIS", sequence="cows")
        assert torch.equal(labels, (frame.labels > 0).long())


class TestOneCleanup:
    """Sources without a model take the options of `Cleanup` too."""

    @pytest.fixture
    def photo(self) -> Tensor:
        import skimage.data

        return torch.from_numpy(skimage.data.coffee()).permute(2, 0, 1).float()[:, ::4, ::4] / 255

    @pytest.mark.parametrize("method", ["auto", "felzenszwalb", "slic", "watershed", "kmeans"])
    def test_least_area_and_budget(self, photo: Tensor, method: str) -> None:
        areas = segment(photo, method, min_size=500, max_regions=3).flatten().bincount()
        assert len(areas) <= 3 and areas.min() >= 500
        assert len(segment(photo, method, min_size=60).unique()) > len(areas)

    @pytest.mark.parametrize("method", ["felzenszwalb", "slic", "watershed", "kmeans"])
    def test_snapping_is_optional(self, photo: Tensor, method: str) -> None:
        maps = [segment(photo, method, snap=snap) for snap in (0, 2, 4)]
        assert len({tuple(labels.flatten().tolist()) for labels in maps}) == 3
        with pytest.raises(ValueError, match="snap must be at least 0; got -1"):
            segment(photo, method, snap=-1)
        for wrong in (1.5, True):
            with pytest.raises(TypeError, match="snap must be an integer; got"):
                segment(photo, method, snap=wrong)

    def test_unknown_option(self, tmp_path: Path) -> None:
        message = "the method 'onnx', model, kind='auto', .*, connected=True, max_regions=None; got 'nams'$"
        with pytest.raises(TypeError, match=message):
            segment(two_colors(), "onnx", model=tmp_path / "net.onnx", nams=["sky"])
