"""merge_regions: contours stay where they save more than they cost."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from kcgs.functional import merge_regions
from kcgs.segment import segment


def noise(*size: int, seed: int = 0) -> Tensor:
    return torch.rand(3, *size, generator=torch.Generator().manual_seed(seed))


class TestMergeRegions:
    def test_contours_of_the_image_stay(self) -> None:
        image = 0.3 + 0.02 * noise(64, 96)
        image[:, :, 60:] += 0.4
        labels = (torch.arange(96) // 30).expand(64, 96)  # contours at 30, where nothing is, 60 and 90
        merged = merge_regions(image, labels)
        assert merged.unique().tolist() == [0, 2]
        assert (merged[:, :60] == 0).all() and (merged[:, 60:] == 2).all()

    def test_objects_stay_apart(self) -> None:
        labels = (torch.arange(96) // 24).expand(64, 96)
        merged = merge_regions(0.3 + 0.02 * noise(64, 96), labels, objects=labels // 2 + 5)
        assert torch.equal(merged, labels // 2 * 2)
        with pytest.raises(ValueError, match="objects must be a map that labels divide .* through the region 1"):
            merge_regions(noise(64, 96), labels, objects=(torch.arange(96) // 30).expand(64, 96))

    @pytest.mark.parametrize(("rows", "count"), [(64, 2), (40, 1)])
    def test_colors_must_differ_along_most_of_a_contour(self, rows: int, count: int) -> None:
        image = 0.3 + 0.02 * noise(64, 96)
        image[:, :rows, 48:] += 0.4
        labels = (torch.arange(96) // 48).expand(64, 96)
        assert len(merge_regions(image, labels).unique()) == count

    def test_one_region_where_the_image_needs_none(self) -> None:
        y, x = torch.meshgrid(torch.linspace(0, 1, 90), torch.linspace(0, 1, 120), indexing="ij")
        ramp = (0.5 * x + 0.3 * y).expand(3, -1, -1)
        cells = (torch.arange(90)[:, None] // 30) * 4 + torch.arange(120) // 30
        assert len(merge_regions(ramp, cells).unique()) == 1
        assert segment(ramp).max() == 0
        assert segment((ramp + 0.05 * noise(90, 120)).clamp(0, 1)).max() == 0

    def test_a_higher_cost_merges_more(self) -> None:
        image = torch.stack([torch.arange(8.0).repeat_interleave(12) ** 1.5 / 20] * 3)[:, None].expand(3, 64, 96)
        labels = (torch.arange(96) // 12).expand(64, 96)
        counts = [len(merge_regions(image, labels, cost).unique()) for cost in (0.0, 0.005, 0.02, 1.0)]
        assert counts[0] == 8 and counts == sorted(counts, reverse=True) and counts[-1] == 1

    @pytest.mark.parametrize(
        ("labels", "cost", "words"),
        [
            (torch.zeros(8, 8).long(), -1.0, "merge_cost must be finite and at least 0"),
            (torch.full((8, 8), 0.5), 0.1, "labels"),
        ],
    )
    def test_exception(self, labels: Tensor, cost: float, words: str) -> None:
        with pytest.raises((TypeError, ValueError), match=words):
            merge_regions(noise(8, 8), labels, cost)
