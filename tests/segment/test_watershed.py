"""Watershed: minima of a stated depth, a stated number, edges followed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import skimage.data
import torch
from torch import Tensor

from kcgs.data import load_image
from kcgs.functional import edge_alignment
from kcgs.segment import connected_regions, watershed
from kcgs.segment.methods.edges import _deepest_minima, _edge_strength, _minima


def coffee() -> Tensor:
    return torch.from_numpy(skimage.data.coffee()).permute(2, 0, 1).float()[:, ::2, ::2] / 255


class TestMinima:
    # valleys at 0, 2, 1 between walls of 5, 3 and 6
    PROFILE = np.array([[6.0, 0.0, 5.0, 2.0, 3.0, 1.0, 6.0]])

    @pytest.mark.parametrize(
        ("depth", "at"), [(0.0, [1, 3, 5]), (0.5, [1, 3, 5]), (1.5, [1, 5]), (3.9, [1, 5]), (4.1, [1]), (9.0, [])]
    )
    def test_depth(self, depth: float, at: list[int]) -> None:
        seeds = _minima(self.PROFILE, depth)[0]
        assert seeds.max() == len(at)
        assert all(seeds[place] > 0 for place in at)

    @pytest.mark.parametrize("number", [1, 2, 3, 4])
    def test_number(self, number: int) -> None:
        seeds = _deepest_minima(self.PROFILE, number)[0]
        assert seeds.max() == min(number, 3)
        assert seeds[1] > 0

    def test_equal_minima_are_not_torn_apart(self) -> None:
        twins = np.array([[4.0, 1.0, 4.0, 1.0, 4.0]])
        assert _deepest_minima(twins, 1).max() == 1
        assert _deepest_minima(twins, 2).max() == 2


def test_edge_strength_is_the_slope_of_lightness() -> None:
    image = torch.linspace(0.4, 0.6, 21).expand(3, 9, -1)
    from skimage.color import rgb2lab

    lightness = rgb2lab(image.permute(1, 2, 0).numpy())[4, :, 0]
    assert _edge_strength(image, 0.0)[4, 10] == pytest.approx((lightness[11] - lightness[9]) / 2, abs=1e-3)


def test_level_image_is_one_region() -> None:
    assert (watershed(torch.full((3, 20, 30), 0.3)) == 0).all()
    assert (watershed(torch.full((3, 20, 30), 0.3), num_segments=5) == 0).all()


@pytest.mark.parametrize("options", [{}, {"num_segments": 60}, {"snap": 0}, {"sigma": 0.0, "depth": 0.0}])
def test_promises(options: dict[str, float]) -> None:
    image = coffee()
    labels = watershed(image, max_regions=8, **options)  # type: ignore[arg-type]
    areas = labels.flatten().bincount()
    assert 2 <= len(areas) <= 8
    assert (areas[:-1] >= areas[1:]).all() and areas.min() >= 240
    assert int(connected_regions(labels).max()) + 1 == len(areas)
    assert torch.equal(labels, watershed(image.clone(), max_regions=8, **options))  # type: ignore[arg-type]


def test_deeper_minima_are_fewer_regions() -> None:
    counts = [int(watershed(coffee(), depth=depth, max_regions=500).max()) for depth in (1.0, 4.0, 15.0)]
    assert counts[0] > counts[1] > counts[2]


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"sigma": -1.0}, ValueError),
        ({"sigma": float("nan")}, ValueError),
        ({"depth": -0.1}, ValueError),
        ({"depth": float("inf")}, ValueError),
        ({"num_segments": 0}, ValueError),
        ({"num_segments": 2.5}, TypeError),
        ({"max_regions": 0}, ValueError),
        ({"min_size": 0}, ValueError),
    ],
)
def test_bad_options(options: dict[str, float], error: type[Exception]) -> None:
    with pytest.raises(error, match=f"{next(iter(options))} must be .* got"):
        watershed(torch.zeros(3, 4, 4), **options)  # type: ignore[arg-type]


def test_follows_human_contours(data_root: Path) -> None:
    folders = [data_root / "bsds" / name for name in ("42049", "112056", "253027")]
    if not all(folder.is_dir() for folder in folders):
        pytest.skip(f"no BSDS photos in {data_root}")
    for folder in folders:
        image = load_image(folder / "image.jpg")
        labels = watershed(image)
        assert edge_alignment(image, labels) > 0.65
