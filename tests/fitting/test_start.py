"""Starts: counts, ids, determinism, where the centres go, odd regions."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from kcgs import RegionMap
from kcgs.fitting import FitConfig, initial_field, make_problem
from kcgs.fitting.initial import random_field
from kcgs.functional import lookup_regions
from kcgs.nn import GaussianField


def of_one_image(start: Callable[..., GaussianField]) -> Callable[..., GaussianField]:
    return lambda image, *arguments: start(image[None], *arguments)[0]


START = {"random": of_one_image(random_field), "uniform": initial_field}


def scene(size: tuple[int, int] = (48, 64), channels: int = 3) -> tuple[Tensor, Tensor]:
    """Detail on the left, little on the right; a disc and a bar on a ground."""
    y, x = torch.meshgrid(torch.arange(size[0]), torch.arange(size[1]), indexing="ij")
    labels = torch.zeros(size, dtype=torch.long)
    labels[(x - 20) ** 2 + (y - 16) ** 2 < 100] = 3
    labels[30:40, 40:60] = 11
    phases = torch.arange(channels)[:, None, None]
    image = 0.5 + 0.2 * torch.sin(x * 0.9 + phases) * (x < size[1] // 2) + 0.02 * labels
    return image.clamp(0, 1), labels


@pytest.mark.parametrize("name", START)
class TestEvery:
    @pytest.mark.parametrize(
        ("count", "channels", "dtype"), [(1, 3, torch.float32), (40, 1, torch.float64), (500, 8, torch.float32)]
    )
    def test_counts_shapes_and_ids(self, name: str, count: int, channels: int, dtype: torch.dtype) -> None:
        image, labels = scene(channels=channels)
        regions = RegionMap(labels)
        field = START[name](image.to(dtype), count, regions, 0)
        assert field.num_gaussians == count and field.size == (48, 64) and field.colors.shape == (count, channels)
        assert field.region_ids is not None and bool((regions.index_of(field.region_ids) >= 0).all())
        assert all(torch.isfinite(t).all() for t in (field.means, field.cholesky, field.colors))
        assert field.colors.dtype == dtype

    def test_same_seed_same_bits(self, name: str) -> None:
        image, labels = scene()
        a, b, c = (START[name](image, 60, RegionMap(labels), seed) for seed in (2, 2, 3))
        for part in ("means", "cholesky", "colors", "region_ids"):
            assert torch.equal(getattr(a, part), getattr(b, part))
        assert not torch.equal(a.means, c.means)

    def test_as_many_gaussians_as_pixels(self, name: str) -> None:
        labels = torch.tensor([[0, 0, 5], [0, 9, 9]])
        field = START[name](torch.rand(2, 2, 3), 6, RegionMap(labels), 0)
        assert field.num_gaussians == 6 and len(field.means.unique(dim=0)) == 6


class TestInitialField:
    def test_has_the_colours_of_the_image(self) -> None:
        image, labels = scene()
        field = initial_field(image, 400, RegionMap(labels), 0)
        x, y = field.means.detach().long().unbind(-1)
        torch.testing.assert_close(field.colors.detach() * (math.pi / 2), image[:, y, x].T)
        assert field.region_ids is not None
        assert torch.equal(lookup_regions(field.means, labels), field.region_ids)

    def test_every_region_has_one(self) -> None:
        image, labels = scene()
        labels[0, 0] = 99
        field = initial_field(image, 4, RegionMap(labels), 0)
        assert field.region_ids is not None and sorted(field.region_ids.tolist()) == [0, 3, 11, 99]

    def test_fewer_gaussians_than_regions(self) -> None:
        labels = torch.arange(12).view(3, 4)
        field = initial_field(torch.full((1, 3, 4), 0.5), 5, RegionMap(labels), 0)
        assert field.region_ids is not None and len(field.region_ids.unique()) == 5

    @pytest.mark.parametrize("maps", ["none", "one", "masks", "RegionMap"])
    def test_a_batch_is_its_images(self, maps: str) -> None:
        image, labels = scene()
        images = torch.stack([image.roll(5 * k, -1) for k in range(3)])
        each = torch.stack([labels.roll(5 * k, -1) for k in range(3)])
        regions = {"none": None, "one": labels, "masks": each[:, None].float(), "RegionMap": RegionMap(each)}[maps]
        alone = [None if maps == "none" else labels if maps == "one" else each[k] for k in range(3)]
        batch = initial_field(images, 40, regions, seed=2)
        assert batch.means.shape == (3, 40, 2)
        for k, field in enumerate(batch.unbind()):
            expected = initial_field(images[k], 40, alone[k], seed=2)
            assert torch.equal(field.colors, expected.colors) and torch.equal(field.means, expected.means)
            assert field.region_ids is expected.region_ids or torch.equal(field.region_ids, expected.region_ids)  # type: ignore[arg-type]

    def test_parameters_without_a_graph(self) -> None:
        with torch.no_grad():
            field = initial_field(scene()[0][None], 10)
        assert all(p.requires_grad and p.is_leaf for p in field.parameters()) and field.num_images == 1

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            ({"image": torch.zeros(3, 1, 4, 4), "regions": torch.zeros(2, 4, 4).long()},
             r"regions must be one map, or one for each of 3 images, of the image's size \(4, 4\); got \(2, 4, 4\)"),
            ({"image": torch.zeros(0, 1, 4, 4)}, "image must not be empty"),
            ({"num_gaussians": 50}, "num_gaussians must be at most 16"),
            ({"seed": -1}, "seed must be in"),
        ],
    )  # fmt: skip
    def test_bad_input(self, change: dict[str, object], words: str) -> None:
        arguments = {"image": torch.zeros(3, 4, 4), "num_gaussians": 2, **change}
        with pytest.raises(ValueError, match=words):
            initial_field(**arguments)  # type: ignore[arg-type]


@pytest.mark.parametrize(("size", "count"), [((6, 8), 48), ((32, 48), 100), ((200, 160), 320)])
def test_the_number_of_gaussians_is_that_of_the_size(size: tuple[int, int], count: int) -> None:
    assert make_problem(torch.rand(3, *size), None, None, FitConfig(), 0).num_gaussians == count
    assert make_problem(torch.rand(2, 3, *size), None, None, FitConfig(), 0).num_gaussians == count
