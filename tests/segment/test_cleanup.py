"""Cleaning up label maps: pieces, specks, merging, order, contours."""

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from torch import Tensor

from kcgs.segment import connected_regions, merge_similar, merge_small, order_by_area, snap_contours

MAPS = hnp.arrays(
    np.int64, hnp.array_shapes(min_dims=2, max_dims=2, max_side=9), elements=st.sampled_from([0, 1, 2, 9, 10**9])
).map(torch.from_numpy)


def pieces_by_flooding(labels: Tensor) -> list[list[int]]:
    """Label connected pieces the slow way, in raster order of their first pixel."""
    height, width = labels.shape
    out = [[-1] * width for _ in range(height)]
    count = 0
    for row in range(height):
        for column in range(width):
            if out[row][column] >= 0:
                continue
            stack = [(row, column)]
            out[row][column] = count
            while stack:
                y, x = stack.pop()
                for j, i in ((y + 1, x), (y - 1, x), (y, x + 1), (y, x - 1)):
                    inside = 0 <= j < height and 0 <= i < width
                    if inside and out[j][i] < 0 and labels[j, i] == labels[y, x]:
                        out[j][i] = count
                        stack.append((j, i))
            count += 1
    return out


BAD_LABELS: list[tuple[Any, type[Exception]]] = [
    (torch.zeros(3, 3), TypeError),
    (np.zeros((3, 3)), TypeError),
    (torch.zeros(1, 3, 3, dtype=torch.int64), ValueError),
    (torch.zeros(0, 3, dtype=torch.int64), ValueError),
    (torch.tensor([[0, -1]]), ValueError),
]


class TestConnectedRegions:
    @given(MAPS)
    @settings(max_examples=60)
    def test_equals_flooding(self, labels: Tensor) -> None:
        result = connected_regions(labels)
        assert result.dtype == torch.int64
        assert result.tolist() == pieces_by_flooding(labels)

    def test_masks_and_arrays_are_maps(self) -> None:
        labels, image = (torch.arange(40) >= 30).expand(20, 40), torch.rand(3, 20, 40)
        for step in (
            connected_regions,
            order_by_area,
            lambda m: merge_small(m, 3),
            lambda m: merge_similar(image, m, 1),
            lambda m: merge_similar(image, m, None),
            lambda m: snap_contours(image, m, reach=2),
        ):
            assert torch.equal(step(labels.numpy()), step(labels.long()))

    def test_diagonal_pixels_are_apart(self) -> None:
        assert connected_regions(torch.tensor([[0, 1], [1, 0]])).tolist() == [[0, 1], [2, 3]]

    @pytest.mark.parametrize(("labels", "error"), BAD_LABELS)
    def test_bad_labels(self, labels: Any, error: type[Exception]) -> None:
        with pytest.raises(error, match="labels must"):
            connected_regions(labels)


class TestOrderByArea:
    @given(MAPS)
    @settings(max_examples=60)
    def test_areas_decrease_and_regions_stay(self, labels: Tensor) -> None:
        result = order_by_area(labels)
        areas = result.flatten().bincount()
        assert (areas > 0).all()
        assert (areas[:-1] >= areas[1:]).all()
        assert len(areas) == len(labels.unique()) == len(torch.stack([labels, result]).flatten(1).unique(dim=1).T)

    def test_ties_by_first_pixel(self) -> None:
        assert order_by_area(torch.tensor([[7, 3, 5], [5, 3, 7]])).tolist() == [[0, 1, 2], [2, 1, 0]]

    @pytest.mark.parametrize(("labels", "error"), BAD_LABELS)
    def test_bad_labels(self, labels: Any, error: type[Exception]) -> None:
        with pytest.raises(error, match="labels must"):
            order_by_area(labels)


class TestMergeSmall:
    def test_longest_border_wins(self) -> None:
        labels = torch.tensor([[1, 1, 1, 2], [1, 7, 2, 2], [2, 2, 2, 2]])
        # The speck has one side with 1 above, one left, one with 2 right and one below: equal, 2 is larger.
        assert merge_small(labels, 2)[1, 1] == 2
        labels = torch.tensor([[1, 1, 1, 2], [1, 7, 7, 2], [1, 1, 2, 2], [2, 2, 2, 2]])
        assert merge_small(labels, 3)[1, 1:3].tolist() == [1, 1]

    def test_equal_neighbours_the_earlier_wins(self) -> None:
        assert merge_small(torch.tensor([[5, 5, 9, 4, 4]]), 2).tolist() == [[5, 5, 5, 4, 4]]

    def test_specks_may_join_to_a_region(self) -> None:
        labels = torch.tensor([[0, 0, 0, 0, 0, 0], [0, 1, 2, 3, 0, 0], [0, 1, 2, 3, 0, 0], [0, 0, 0, 0, 0, 0]])
        result = merge_small(labels, 3)
        assert len(result.unique()) <= 2
        assert (result == 0).sum() >= (labels == 0).sum()

    def test_pieces_of_a_large_region_are_specks_too(self) -> None:
        labels = torch.tensor([[4, 4, 8, 8, 4], [4, 4, 8, 8, 8]])
        assert merge_small(labels, 2).tolist() == [[4, 4, 8, 8, 8], [4, 4, 8, 8, 8]]

    def test_ids_of_the_others_stay(self) -> None:
        labels = torch.tensor([[10**9, 10**9, 255, 0, 0]])
        assert merge_small(labels, 1).tolist() == labels.tolist()
        assert set(merge_small(labels, 2).unique().tolist()) == {0, 10**9}

    def test_one_region_smaller_than_the_minimum(self) -> None:
        assert merge_small(torch.full((2, 2), 6), 100).tolist() == [[6, 6], [6, 6]]

    @given(MAPS, st.integers(1, 20))
    @settings(max_examples=80)
    def test_no_speck_is_left(self, labels: Tensor, min_size: int) -> None:
        result = merge_small(labels, min_size)
        areas = connected_regions(result).flatten().bincount()
        assert len(areas) == 1 or areas.min() >= min_size
        assert torch.isin(result, labels).all()
        kept = connected_regions(labels).flatten()
        large = kept.bincount()[kept] >= min_size
        # What was large enough keeps its label wherever something large exists.
        if large.any():
            assert torch.equal(result.flatten()[large], labels.flatten()[large])

    def test_many_specks(self) -> None:
        noise = torch.randint(0, 2, (480, 854), generator=torch.Generator().manual_seed(0))
        result = merge_small(noise, 50)
        assert connected_regions(result).flatten().bincount().min() >= 50

    @pytest.mark.parametrize(("labels", "error"), BAD_LABELS)
    def test_bad_labels(self, labels: Any, error: type[Exception]) -> None:
        with pytest.raises(error, match="labels must"):
            merge_small(labels, 2)

    @pytest.mark.parametrize(
        ("min_size", "error"), [(0, ValueError), (-1, ValueError), (2.0, TypeError), (True, TypeError)]
    )
    def test_bad_min_size(self, min_size: Any, error: type[Exception]) -> None:
        with pytest.raises(error, match=r"min_size must be .* got"):
            merge_small(torch.zeros(2, 2, dtype=torch.int64), min_size)


class TestMergeSimilar:
    def test_nearest_adjacent_pair_first(self) -> None:
        image = torch.tensor([[[0.1, 0.9, 0.15, 0.8, 0.82]]]).expand(3, 2, 5)
        labels = torch.arange(5).expand(2, 5)
        assert merge_similar(image, labels, 4)[0].tolist() == [0, 1, 2, 3, 3]
        # 0 and 2 are alike but do not touch: 1 joins the pair at the right only when nothing else is nearer.
        assert merge_similar(image, labels, 3)[0].tolist()[0] == 0
        assert len(merge_similar(image, labels, 1).unique()) == 1

    def test_nearest_in_lab_rather_than_in_rgb(self) -> None:
        # Green is 0.12 away from grey in RGB and 22.7 in Lab, blue 0.14 and 20.6.
        gray, green, blue = (0.5, 0.5, 0.5), (0.5, 0.62, 0.5), (0.5, 0.5, 0.64)
        image = torch.tensor([[green, gray, blue]]).permute(2, 0, 1)
        assert merge_similar(image, torch.tensor([[0, 1, 2]]), 2).tolist() == [[0, 1, 1]]

    def test_mean_is_weighted_by_area(self) -> None:
        # After 0 and 1 merge (nine dark pixels, one lighter), the mean is dark: 2 is nearer to 3.
        values = torch.tensor([0.30] * 9 + [0.34] + [0.42] * 5 + [0.50] * 5)
        labels = torch.tensor([[0] * 9 + [1] + [2] * 5 + [3] * 5])
        result = merge_similar(values[None, None].expand(3, 1, 20), labels, 2)
        assert result[0].tolist() == [0] * 10 + [2] * 10

    def test_id_of_the_largest_part(self) -> None:
        image = torch.tensor([[[0.1, 0.11, 0.11, 0.9]]])
        assert merge_similar(image, torch.tensor([[7, 3, 3, 5]]), 2).tolist() == [[3, 3, 3, 5]]

    def test_few_enough_stay(self) -> None:
        labels = torch.tensor([[3, 9]])
        assert torch.equal(merge_similar(torch.zeros(1, 1, 2), labels, 2), labels)

    @given(MAPS, st.integers(1, 8), st.integers(0, 2**32))
    @settings(max_examples=60)
    def test_count_and_connectedness(self, labels: Tensor, most: int, seed: int) -> None:
        regions = connected_regions(labels)
        image = torch.rand(3, *labels.shape, generator=torch.Generator().manual_seed(seed))
        result = merge_similar(image, regions, most)
        assert len(result.unique()) == min(most, int(regions.max()) + 1)
        assert int(connected_regions(result).max()) + 1 == len(result.unique())
        joint = torch.stack([regions.flatten(), result.flatten()]).unique(dim=1)
        assert joint.shape[1] == int(regions.max()) + 1  # no region was split

    def test_sizes_differ(self) -> None:
        with pytest.raises(ValueError, match=r"labels must have the image's size; got \(2, 2\)"):
            merge_similar(torch.zeros(3, 2, 3), torch.zeros(2, 2, dtype=torch.int64), 1)

    @pytest.mark.parametrize(("most", "error"), [(0, ValueError), (1.5, TypeError)])
    def test_bad_count(self, most: Any, error: type[Exception]) -> None:
        with pytest.raises(error, match="max_regions must be"):
            merge_similar(torch.zeros(3, 2, 2), torch.zeros(2, 2, dtype=torch.int64), most)


class TestSnapContours:
    def test_moves_to_the_edge_within_reach(self) -> None:
        image = torch.zeros(3, 20, 40)
        image[..., 20:] = 1.0
        edge = (torch.arange(40) >= 20).long().expand(20, 40)
        for offset in (-2, -1, 0, 1, 2):
            moved = (torch.arange(40) >= 20 + offset).long().expand(20, 40)
            assert torch.equal(snap_contours(image, moved), edge)
        far = (torch.arange(40) >= 26).long().expand(20, 40)
        assert not torch.equal(snap_contours(image, far), edge)
        assert torch.equal(snap_contours(image, far, reach=7), edge)

    def test_whisker_goes(self) -> None:
        image = torch.zeros(3, 30, 40)
        image[..., 20:] = 1.0
        clean = (torch.arange(40) >= 20).long().repeat(30, 1)
        whiskered = clean.clone()
        whiskered[15, 8:20] = 1
        assert torch.equal(snap_contours(image, whiskered), clean)

    def test_blur_between_two_regions_is_dissolved(self) -> None:
        ramp = torch.cat([torch.zeros(18), torch.linspace(0, 1, 4), torch.ones(18)])
        image = ramp.expand(3, 20, 40)
        labels = torch.tensor([0] * 18 + [1] * 4 + [2] * 18).expand(20, 40)
        assert snap_contours(image, labels).unique().tolist() == [0, 2]

    def test_a_line_of_its_own_colour_stays(self) -> None:
        image = torch.zeros(3, 20, 40)
        image[..., 20:] = 1.0
        image[:, :, 18:22] = torch.tensor([1.0, 0.0, 0.0])[:, None, None]
        labels = torch.tensor([0] * 18 + [1] * 4 + [2] * 18).expand(20, 40)
        assert torch.equal(snap_contours(image, labels), labels)

    def test_thin_regions_alone_stay(self) -> None:
        image = torch.linspace(0, 1, 12).expand(3, 10, 12)
        labels = (torch.arange(12) // 2).expand(10, 12)
        assert torch.equal(snap_contours(image, labels), labels)

    @given(MAPS, st.integers(0, 2**32), st.integers(1, 3))
    @settings(max_examples=60)
    def test_ids_come_from_the_map(self, labels: Tensor, seed: int, reach: int) -> None:
        image = torch.rand(3, *labels.shape, generator=torch.Generator().manual_seed(seed))
        result = snap_contours(image, labels, reach=reach)
        assert result.shape == labels.shape
        assert torch.isin(result, labels).all()

    @pytest.mark.parametrize(("reach", "error"), [(0, ValueError), (1.0, TypeError), (True, TypeError)])
    def test_bad_reach(self, reach: Any, error: type[Exception]) -> None:
        with pytest.raises(error, match="reach must be"):
            snap_contours(torch.zeros(3, 2, 2), torch.zeros(2, 2, dtype=torch.int64), reach=reach)

    def test_sizes_differ(self) -> None:
        with pytest.raises(ValueError, match="labels must have the image's size"):
            snap_contours(torch.zeros(3, 2, 3), torch.zeros(2, 2, dtype=torch.int64))
