"""k-means in Lab: exact colours come back, the number is found or kept, pieces are exact."""

from __future__ import annotations

import numpy as np
import pytest
import skimage.data
import torch
from kornia.contrib import connected_components, connected_components_union_find

from kcgs.data import chart_pie
from kcgs.segment import connected_regions, kmeans
from kcgs.segment.methods.kmeans import _centres


def patches(*colors: tuple[float, float, float]) -> torch.Tensor:
    return torch.tensor(colors).T[:, None, :].repeat_interleave(16, 2).repeat_interleave(24, 1)


RED, GREEN, BLUE, GRAY = (0.8, 0.1, 0.1), (0.1, 0.7, 0.1), (0.1, 0.1, 0.8), (0.5, 0.5, 0.5)


class TestCentres:
    CLOUDS = np.repeat([[20.0, 0, 0], [60, 40, 0], [60, -40, 10], [90, 0, 0]], 50, axis=0)

    def test_well_separated_colours_are_found(self) -> None:
        noisy = self.CLOUDS + np.random.default_rng(0).normal(0, 1, self.CLOUDS.shape)
        centres = _centres(noisy, None)
        assert sorted(centres[:, 0].round(-1).tolist()) == [20, 60, 60, 90]

    @pytest.mark.parametrize("number", [1, 2, 3, 4, 7])
    def test_given_number_or_as_many_colours_as_there_are(self, number: int) -> None:
        assert len(_centres(self.CLOUDS, number)) == min(number, 4)

    def test_nearly_flat_is_one_colour(self) -> None:
        flat = np.random.default_rng(0).normal(50, 1, (500, 3))
        assert len(_centres(flat, None)) == 1


def test_every_patch_is_a_region() -> None:
    labels = kmeans(patches(RED, GREEN, BLUE, RED, GRAY), sigma=0.0)
    assert torch.equal(labels, torch.arange(5).repeat_interleave(16).expand(24, -1))  # the two reds apart


def test_budget_merges_the_most_similar() -> None:
    labels = kmeans(patches(RED, (0.75, 0.12, 0.1), BLUE), num_clusters=3, sigma=0.0, max_regions=2)
    assert labels[0, ::16].tolist() == [0, 0, 1]


def test_chart_comes_back() -> None:
    chart = chart_pie()
    labels = kmeans(chart.image, num_clusters=9)
    assert len(labels.unique()) >= 6
    shares = [(labels[chart.labels == region].bincount().max() / (chart.labels == region).sum()) for region in range(9)]
    assert sum(float(share) > 0.98 for share in shares) >= 8


@pytest.mark.parametrize("options", [{}, {"num_clusters": 5}, {"snap": 0, "sigma": 2.0}])
def test_promises(options: dict[str, float]) -> None:
    image = torch.from_numpy(skimage.data.coffee()).permute(2, 0, 1).float()[:, ::2, ::2] / 255
    labels = kmeans(image, max_regions=12, **options)  # type: ignore[arg-type]
    areas = labels.flatten().bincount()
    assert 2 <= len(areas) <= 12
    assert (areas[:-1] >= areas[1:]).all() and areas.min() >= 240
    assert int(connected_regions(labels).max()) + 1 == len(areas)
    assert torch.equal(labels, kmeans(image.clone(), max_regions=12, **options))  # type: ignore[arg-type]


def test_why_pieces_are_not_kornias() -> None:
    snake = torch.zeros(1, 1, 41, 41)
    snake[..., ::2, :] = 1.0
    snake[..., 1::4, -1] = snake[..., 3::4, 0] = 1.0
    assert len(connected_regions(snake[0, 0].long())[snake[0, 0] > 0].unique()) == 1
    pooled = connected_components(snake)
    assert len(pooled[snake > 0].unique()) > 1  # one piece, longer than its steps
    corner = torch.eye(2)[None, None]
    assert len(connected_components_union_find(corner)[corner > 0].unique()) == 1
    assert len(connected_regions(corner[0, 0].long()).unique()) == 4


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"num_clusters": 0}, ValueError),
        ({"num_clusters": 2.0}, TypeError),
        ({"sigma": -1.0}, ValueError),
        ({"max_regions": 0}, ValueError),
        ({"min_size": 0}, ValueError),
    ],
)
def test_bad_options(options: dict[str, float], error: type[Exception]) -> None:
    with pytest.raises(error, match=f"{next(iter(options))} must be .* got"):
        kmeans(torch.zeros(3, 4, 4), **options)  # type: ignore[arg-type]
