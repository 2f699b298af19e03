"""The colour charts: sizes, colours, labels, edges."""

from collections.abc import Callable
from typing import Any

import pytest
import torch

from kcgs.data import ChartSample, chart_2x3, chart_pie


@pytest.mark.parametrize(("chart", "height"), [(chart_2x3, 200), (chart_pie, 300)])
@pytest.mark.parametrize("scale", [1, 3])
def test_sizes_and_types(chart: Callable[..., ChartSample], height: int, scale: int) -> None:
    image, labels = chart(scale=scale)
    assert image.shape == (3, height * scale, 300 * scale) and labels.shape == image.shape[1:]
    assert (image.dtype, labels.dtype) == (torch.float32, torch.int64) and image.is_contiguous()
    assert 0 <= image.min() <= image.max() <= 1
    assert torch.equal(chart(scale=scale).image, image)


@pytest.mark.parametrize("chart", [chart_2x3, chart_pie])
@pytest.mark.parametrize(
    ("scale", "message"), [(0, "scale must be at least 1; got 0"), (1.5, "scale must be an integer; got 1.5")]
)
def test_bad_scale(chart: Callable[..., ChartSample], scale: Any, message: str) -> None:
    with pytest.raises((TypeError, ValueError), match=message):
        chart(scale)


class TestChart2x3:
    @pytest.mark.parametrize("scale", [1, 2])
    def test_flat_blocks_with_straight_edges(self, scale: int) -> None:
        image, labels = chart_2x3(scale)
        colors = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0.5, 0), (1, 0.5, 0), (0.5, 0, 0.5)]
        side = 100 * scale
        for region, color in enumerate(colors):
            row, column = divmod(region, 3)
            block = (slice(side * row, side * (row + 1)), slice(side * column, side * (column + 1)))
            assert (labels[block] == region).all()
            assert (image[:, *block] == torch.tensor(color)[:, None, None]).all()


class TestChartPie:
    def test_sectors_clockwise_from_the_top(self) -> None:
        image, labels = chart_pie()
        colors = [(1, 0, 0), (1, 0.5, 0), (1, 1, 0), (0, 1, 0), (0, 1, 1), (0, 0, 1), (0.5, 0, 0.5), (1, 0, 1)]
        for sector, color in enumerate(colors):
            angle = torch.tensor(sector * torch.pi / 4)
            x, y = (150 + 80 * angle.sin()).int(), (150 - 80 * angle.cos()).int()
            assert labels[y, x] == sector + 1 and image[:, y, x].tolist() == list(color)
        assert (labels[0] == 0).all() and (image[:, 0] == 1).all()

    @pytest.mark.parametrize("scale", [1, 2])
    def test_areas(self, scale: int) -> None:
        areas = chart_pie(scale).labels.flatten().bincount().double() / scale**2
        disc = torch.pi * 130**2
        assert abs(areas[1:].sum() - disc) < 0.002 * disc
        assert ((areas[1:] - disc / 8).abs() < 0.01 * disc / 8).all()

    def test_pixels_are_means_over_their_area(self) -> None:
        """Of 8 x 8 samples, in the quarter at the top left."""
        image, labels = chart_pie()
        colors = torch.stack([image[:, labels == k].median(dim=1).values for k in range(9)])
        x = (torch.arange(1200, dtype=torch.float64) + 0.5) / 8 - 150
        y = x[:, None]
        sector = (torch.atan2(x, -y) / (torch.pi / 4) + 0.5).floor() % 8 + 1
        samples = colors[torch.where(x**2 + y**2 < 130**2, sector, 0).long()]
        expected = samples.reshape(150, 8, 150, 8, 3).mean(dim=(1, 3))
        torch.testing.assert_close(image.permute(1, 2, 0)[:150, :150], expected, atol=1e-5, rtol=0)
        is_flat = (expected[:, :, None] == colors).all(dim=-1).any(dim=-1)
        assert (~is_flat).sum() > 300  # a rim and edges of mixed pixels
