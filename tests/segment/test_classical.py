"""Segmenters by name: what every method promises, and that ``auto`` follows real objects."""

import functools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import skimage.data
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from kcgs.data import chart_2x3, chart_pie, load_image, load_labels
from kcgs.functional import edge_alignment, merge_regions
from kcgs.segment import (
    Segmenter,
    auto,
    available_methods,
    connected_regions,
    felzenszwalb,
    kmeans,
    register,
    segment,
    slic,
    watershed,
)

METHODS = ["auto", "felzenszwalb", "kmeans", "slic", "watershed"]


def photo(name: str) -> Tensor:
    return torch.from_numpy(getattr(skimage.data, name)()).permute(2, 0, 1).float() / 255


@functools.cache
def auto_of(name: str) -> Tensor:
    """Segment a photo once for all that several tests ask of its regions."""
    return auto(photo(name))


def assert_clean(labels: Tensor, size: tuple[int, ...]) -> None:
    """Check what every segmenter promises: int64, ids without gaps by decreasing area, connected."""
    assert labels.dtype == torch.int64
    assert labels.shape == size
    areas = labels.flatten().bincount()
    assert (areas > 0).all()
    assert (areas[:-1] >= areas[1:]).all()
    assert int(connected_regions(labels).max()) + 1 == len(areas)


def covering(labels: Tensor, truth: Tensor) -> float:
    """Mean over the pixels of the best overlap (intersection over union) of their true region."""
    truth = truth.unique(return_inverse=True)[1]
    count = int(labels.max()) + 1
    shared = (truth * count + labels).flatten().bincount(minlength=(int(truth.max()) + 1) * count)
    shared = shared.reshape(-1, count).double()
    union = shared.sum(1, keepdim=True) + shared.sum(0, keepdim=True) - shared
    return float(((shared / union).max(dim=1).values * shared.sum(1)).sum() / truth.numel())


class TestRegistry:
    def test_methods(self) -> None:
        assert set(METHODS) <= set(available_methods())
        assert available_methods() == sorted(available_methods())

    def test_functions_are_segmenters(self) -> None:
        functions: list[Segmenter] = [auto, felzenszwalb, kmeans, slic, watershed]
        image = torch.zeros(3, 8, 8)
        for name, function in zip(METHODS, functions, strict=True):
            assert torch.equal(segment(image, name), function(image))

    def test_auto_is_the_default_and_options_arrive(self) -> None:
        image = photo("chelsea")
        assert torch.equal(segment(image), auto_of("chelsea"))
        assert len(segment(image, max_regions=3).unique()) == 3

    def test_unknown_method_lists_the_known(self) -> None:
        with pytest.raises(ValueError, match=r"method must be one of auto, .*felzenszwalb, .*slic.*; got 'magic'"):
            segment(torch.zeros(3, 4, 4), method="magic")

    def test_unknown_option(self) -> None:
        with pytest.raises(TypeError, match="colour"):
            segment(torch.zeros(3, 4, 4), colour=3)

    @pytest.mark.parametrize(("name", "message"), [("auto", "there is .* 'auto' already"), ("", "non-empty string")])
    def test_bad_name(self, name: str, message: str) -> None:
        with pytest.raises(ValueError, match=message):
            register(name)


class TestEveryMethod:
    @pytest.mark.parametrize("method", METHODS)
    @pytest.mark.parametrize("size", [(1, 1), (1, 2), (1, 60), (60, 1), (2, 2), (3, 50), (17, 31)])
    @pytest.mark.parametrize("channels", [1, 3])
    def test_small_images(self, method: str, size: tuple[int, int], channels: int) -> None:
        image = torch.rand(channels, *size, generator=torch.Generator().manual_seed(0))
        assert_clean(segment(image, method), size)

    @pytest.mark.parametrize("method", METHODS)
    @pytest.mark.parametrize("channels", [1, 3])
    def test_two_halves(self, method: str, channels: int) -> None:
        image = torch.full((channels, 60, 90), 0.2)
        image[..., 30:] = 0.9
        labels = segment(image, method)
        assert_clean(labels, (60, 90))
        if method == "felzenszwalb":  # Leaves the blur of its smoothing as a region.
            labels = felzenszwalb(image, sigma=0.0)
        if method == "slic":
            labels = slic(image, max_regions=2)
        assert torch.equal(labels, (torch.arange(90) < 30).long().expand(60, 90))

    @pytest.mark.parametrize("method", METHODS)
    def test_gray_equals_gray_rgb(self, method: str) -> None:
        gray = photo("chelsea").mean(dim=0, keepdim=True)[:, :120, :160]
        assert torch.equal(segment(gray, method), segment(gray.expand(3, -1, -1), method))

    @pytest.mark.parametrize("method", METHODS)
    def test_same_every_time(self, method: str) -> None:
        image = photo("coffee")[:, ::2, ::2]
        assert torch.equal(segment(image, method), segment(image.clone(), method))

    @pytest.mark.parametrize("method", METHODS)
    def test_double_half_and_gradient(self, method: str) -> None:
        image = photo("chelsea")[:, ::3, ::3]
        assert torch.equal(segment(image.double(), method), segment(image, method))
        assert_clean(segment(image.half().requires_grad_(), method), tuple(image.shape[1:]))

    @pytest.mark.parametrize("method", METHODS)
    def test_image_stays(self, method: str) -> None:
        image = photo("chelsea")[:, :50, :50]
        before = image.clone()
        segment(image, method)
        assert torch.equal(image, before)

    @pytest.mark.parametrize("method", METHODS)
    def test_rounding_beyond_the_range_is_tolerated(self, method: str) -> None:
        image = torch.zeros(3, 8, 8)
        image[0, 0, 0], image[0, 0, 1] = -0.0005, 1.0005
        assert_clean(segment(image, method), (8, 8))

    @pytest.mark.parametrize("method", METHODS)
    @pytest.mark.parametrize(
        ("image", "error", "message"),
        [
            (np.zeros((3, 4, 4)), ValueError, r"image must have shape .*; got \(4, 3, 4\)"),
            ([0.5], TypeError, "image must be a Tensor, a numpy array or a PIL image; got list"),
            (torch.zeros(3, 4, 4, dtype=torch.uint8), TypeError, "image must have a real floating dtype"),
            (torch.zeros(4, 4, 4), ValueError, r"image must have shape \(3, H, W\) or \(1, H, W\); got \(4, 4, 4\)"),
            (torch.zeros(2, 4, 4), ValueError, "image must have shape"),
            (torch.zeros(4, 4), ValueError, "image must have"),
            (torch.zeros(2, 3, 4, 4), ValueError, "image must be one image"),
            (torch.zeros(3, 0, 4), ValueError, "image must not be empty"),
            (torch.full((3, 4, 4), float("nan")), ValueError, "image must be finite"),
            (torch.full((3, 4, 4), 255.0), ValueError, r"image must be in \[0, 1\]; got \[255, 255\]"),
            (torch.full((3, 4, 4), -0.01), ValueError, r"image must be in \[0, 1\]"),
        ],
    )
    def test_bad_image(self, method: str, image: Any, error: type[Exception], message: str) -> None:
        with pytest.raises(error, match=message):
            segment(image, method)

    @pytest.mark.parametrize(
        ("method", "options", "error"),
        [
            ("auto", {"max_regions": 0}, ValueError),
            ("auto", {"max_regions": 2.5}, TypeError),
            ("felzenszwalb", {"scale": 0.0}, ValueError),
            ("felzenszwalb", {"scale": float("nan")}, ValueError),
            ("felzenszwalb", {"sigma": -1.0}, ValueError),
            ("felzenszwalb", {"min_size": 0}, ValueError),
            ("felzenszwalb", {"min_size": 2.0}, TypeError),
            ("felzenszwalb", {"max_regions": 0}, ValueError),
            ("slic", {"num_segments": 0}, ValueError),
            ("slic", {"compactness": 0.0}, ValueError),
            ("slic", {"max_regions": 0}, ValueError),
            ("slic", {"min_size": -1}, ValueError),
        ],
    )
    def test_bad_option(self, method: str, options: dict[str, Any], error: type[Exception]) -> None:
        with pytest.raises(error, match=rf"{next(iter(options))} must be .* got"):
            segment(torch.zeros(3, 4, 4), method, **options)


class TestFelzenszwalb:
    def test_scale_and_minimum(self) -> None:
        image = photo("coffee")
        counts = [int(felzenszwalb(image, scale=scale).max()) + 1 for scale in (100.0, 300.0, 1000.0)]
        assert counts[0] > counts[1] > counts[2] > 1
        assert felzenszwalb(image, scale=50.0, min_size=2000).flatten().bincount().min() >= 2000
        labels = felzenszwalb(image, max_regions=5)
        assert_clean(labels, (400, 600))
        assert int(labels.max()) + 1 == 5


class TestSlic:
    def test_count(self) -> None:
        labels = slic(photo("coffee"), max_regions=7)
        assert_clean(labels, (400, 600))
        assert 3 <= int(labels.max()) + 1 <= 7


class TestAuto:
    @pytest.mark.parametrize("value", [0.0, 0.37, 1.0])
    @pytest.mark.parametrize("channels", [1, 3])
    def test_constant_image_is_one_region(self, value: float, channels: int) -> None:
        assert (auto(torch.full((channels, 120, 80), value)) == 0).all()

    @pytest.mark.parametrize("name", ["astronaut", "coffee", "chelsea"])
    def test_photo_gives_4_to_30_regions_without_specks(self, name: str) -> None:
        labels = auto_of(name)
        assert_clean(labels, tuple(photo(name).shape[1:]))
        areas = labels.flatten().bincount()
        assert 4 <= len(areas) <= 30
        assert areas.min() >= 0.0039 * labels.numel()

    def test_max_regions(self) -> None:
        assert int(auto(photo("astronaut"), max_regions=6).max()) + 1 == 6
        assert int(auto(photo("astronaut"), max_regions=1).max()) == 0

    @pytest.mark.parametrize("scale", [1, 2])
    def test_charts_are_found_exactly(self, scale: int) -> None:
        blocks, pie = chart_2x3(scale), chart_pie(scale)
        labels = auto(blocks.image)
        assert int(labels.max()) + 1 == 6
        assert covering(labels, blocks.labels) > 0.999
        labels = auto(pie.image)
        assert int(labels.max()) + 1 == 9
        assert covering(labels, pie.labels) > 0.99

    def test_coffee_parts(self) -> None:
        labels = auto_of("coffee")
        corner, coffee, cup, plate, table = (
            int(labels[point]) for point in ((30, 40), (130, 290), (50, 300), (330, 420), (200, 560))
        )
        assert len({corner, coffee, cup, plate, table}) == 5
        # Both ends of each belong to it.
        assert labels[330, 180] == plate
        assert labels[60, 210] == cup
        assert labels[80, 500] == table

    def test_gray_photo(self) -> None:
        labels = auto(photo("coffee").mean(dim=0, keepdim=True))
        assert_clean(labels, (400, 600))
        assert 4 <= int(labels.max()) + 1 <= 30

    def test_count_hardly_depends_on_resolution(self) -> None:
        image = photo("coffee")
        counts = [int(auto_of("coffee").max()) + 1]
        for factor in (0.5, 2.0):
            resized = torch.nn.functional.interpolate(image[None], scale_factor=factor, mode="area")[0]
            counts.append(int(auto(resized).max()) + 1)
        assert max(counts) <= 2 * min(counts)

    def test_large_images_are_clean_too(self) -> None:
        pie = chart_pie(scale=4)
        labels = auto(pie.image)  # 1200 x 1200, segmented at a smaller size
        assert_clean(labels, (1200, 1200))
        assert covering(labels, pie.labels) > 0.99

    def test_only_contours_of_photos_of_many_megapixels_are_set_at_full_size(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """12 megapixels took 24 s, of which most went into comparing regions at full size."""
        classical = f"{auto.__module__}.{{}}".format
        sizes = []

        def merging(image: Tensor, labels: Tensor) -> Tensor:
            sizes.append(labels.numel())
            return merge_regions(image, labels)

        monkeypatch.setattr(classical("_LARGE"), 1000)
        monkeypatch.setattr(classical("_MAX_PIXELS"), 20_000)
        monkeypatch.setattr(classical("merge_regions"), merging)
        chart, image = chart_pie(), photo("coffee")
        assert covering(auto(chart.image), chart.labels) > 0.98
        labels = auto(image)
        assert max(sizes) <= 20_500
        assert_clean(labels, (400, 600))
        assert edge_alignment(image, labels) > 0.85  # sharp at full size
        assert (auto(torch.full((3, 120, 80), 0.5)) == 0).all()

    @given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**32), st.sampled_from([0.02, 0.3, 1.0]))
    @settings(max_examples=40)
    def test_any_small_image(self, height: int, width: int, seed: int, contrast: float) -> None:
        noise = torch.rand(3, height, width, generator=torch.Generator().manual_seed(seed))
        assert_clean(auto(noise * contrast), (height, width))


class TestRealData:
    def test_human_regions_are_covered(self, data_root: Path) -> None:
        folders = [data_root / "bsds" / name for name in ("42049", "112056", "134049", "157032", "253027")]
        if not all(folder.is_dir() for folder in folders):
            pytest.skip(f"no BSDS photos in {data_root}")
        scores = []
        for folder in folders:
            image = load_image(folder / "image.jpg")
            labels = auto(image)
            assert_clean(labels, tuple(image.shape[1:]))
            assert 2 <= int(labels.max()) + 1 <= 30
            scores.append(covering(labels, load_labels(folder / "mask.png")))
        assert sum(scores) / len(scores) > 0.67, scores
