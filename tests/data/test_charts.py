"""The colour charts: sizes, colours, labels, edges."""

from collections.abc import Callable
from typing import Any

import pytest
import torch

from kcgs.data import ChartSample, chart_2x3, chart_pie

CHARTS = [chart_2x3, chart_pie]


class TestBoth:
    @pytest.mark.parametrize("chart", CHARTS)
    @pytest.mark.parametrize("scale", [1, 2, 3])
    def test_sizes_and_types(self, chart: Callable[..., ChartSample], scale: int) -> None:
        height, width = (200, 300) if chart is chart_2x3 else (300, 300)
        image, labels = chart(scale=scale)
        assert image.shape == (3, height * scale, width * scale)
        assert labels.shape == image.shape[1:]
        assert (image.dtype, labels.dtype) == (torch.float32, torch.int64)
        assert 0 <= image.min() <= image.max() <= 1
        assert image.is_contiguous()

    @pytest.mark.parametrize("chart", CHARTS)
    def test_same_every_time(self, chart: Callable[..., ChartSample]) -> None:
        first, second = chart(), chart()
        assert torch.equal(first.image, second.image)
        assert torch.equal(first.labels, second.labels)

    @pytest.mark.parametrize("chart", CHARTS)
    @pytest.mark.parametrize("scale", [0, -1])
    def test_scale_out_of_range(self, chart: Callable[..., ChartSample], scale: int) -> None:
        with pytest.raises(ValueError, match="scale must be at least 1; got"):
            chart(scale)

    @pytest.mark.parametrize("chart", CHARTS)
    @pytest.mark.parametrize("scale", [1.5, "2", True, None])
    def test_scale_type(self, chart: Callable[..., ChartSample], scale: Any) -> None:
        with pytest.raises(TypeError, match="scale must be an integer; got"):
            chart(scale)


class TestBlocks:
    def test_flat_blocks_with_straight_edges(self) -> None:
        image, labels = chart_2x3()
        colors = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0.5, 0), (1, 0.5, 0), (0.5, 0, 0.5)]
        for region, color in enumerate(colors):
            row, column = divmod(region, 3)
            block = (slice(100 * row, 100 * row + 100), slice(100 * column, 100 * column + 100))
            assert (labels[block] == region).all()
            assert (image[:, *block] == torch.tensor(color)[:, None, None]).all()

    def test_scale_repeats_pixels(self) -> None:
        small, large = chart_2x3(), chart_2x3(scale=2)
        assert torch.equal(large.image[:, ::2, ::2], small.image)
        assert torch.equal(large.labels[1::2, 1::2], small.labels)


class TestPie:
    def test_sectors_clockwise_from_the_top(self) -> None:
        image, labels = chart_pie()
        expected = [
            (1, 0, 0),
            (1, 0.5, 0),
            (1, 1, 0),
            (0, 1, 0),
            (0, 1, 1),
            (0, 0, 1),
            (0.5, 0, 0.5),
            (1, 0, 1),
        ]
        for sector, color in enumerate(expected):
            angle = torch.tensor(sector * torch.pi / 4)
            x, y = (150 + 80 * angle.sin()).int(), (150 - 80 * angle.cos()).int()
            assert labels[y, x] == sector + 1
            assert image[:, y, x].tolist() == list(color)
        assert (labels[0] == 0).all()
        assert (image[:, 0] == 1).all()

    @pytest.mark.parametrize("scale", [1, 2])
    def test_areas(self, scale: int) -> None:
        _, labels = chart_pie(scale)
        areas = labels.flatten().bincount().double() / scale**2
        disc = torch.pi * 130**2
        assert abs(areas[1:].sum() - disc) < 0.002 * disc
        assert ((areas[1:] - disc / 8).abs() < 0.01 * disc / 8).all()

    def test_edges_are_area_averages(self) -> None:
        # Labels at eight times the size are the 8 x 8 samples of every pixel.
        image, labels = chart_pie()
        fine = chart_pie(scale=8).labels
        colors = torch.stack([image[:, labels == k].median(dim=1).values for k in range(9)])
        expected = colors[fine].reshape(300, 8, 300, 8, 3).mean(dim=(1, 3))
        torch.testing.assert_close(image.permute(1, 2, 0), expected, atol=1e-5, rtol=0)
        pure = (expected[:, :, None] == colors).all(dim=-1).any(dim=-1)
        assert (~pure).sum() > 1000  # the check above saw a rim and eight edges of mixed pixels
