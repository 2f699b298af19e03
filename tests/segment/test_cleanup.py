"""Cleaning up label maps: pieces, specks, merging, order, contours, scores, names."""

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from torch import Tensor

from kcgs.segment import Cleanup, Prediction
from kcgs.segment.cleanup import connect, merge_small

MAPS = hnp.arrays(
    np.int64, hnp.array_shapes(min_dims=2, max_dims=2, max_side=9), elements=st.sampled_from([0, 1, 2, 9, 10**9])
)
GRAY = torch.tensor([[[0.1, 0.9, 0.15, 0.8, 0.82]]])
STEP = (torch.arange(40) >= 20).float().expand(3, 20, 40)


def clean(labels: Any, image: Tensor | None = None, **options: Any) -> list[int]:
    labels = torch.as_tensor(labels)
    image = torch.zeros(3, *labels.shape) if image is None else image
    return Cleanup(**{"min_size": 1, "connected": False, **options}).apply(image, labels).labels[0].tolist()


@pytest.mark.parametrize(
    ("labels", "options", "first_row"),
    [
        ([[9, 4, 4], [9, 4, 7]], {}, [1, 0, 0]),  # by area
        ([[5, 2, 5], [5, 2, 2]], {"connected": True}, [1, 0, 2]),
        ([[3, 3, 3, 8], [3, 1, 3, 8]], {"min_size": 2}, [0, 0, 0, 1]),
        ([[7, 3, 7]], {"min_size": 2}, [0, 0, 0]),
        ([[7, 3]], {"min_size": 9}, [0, 0]),
    ],
)
def test_labels(labels: list[list[int]], options: dict[str, Any], first_row: list[int]) -> None:
    assert clean(labels, **options) == first_row


def test_nearest_neighbours_merge_first() -> None:
    labels = torch.arange(5).expand(2, 5)
    image = GRAY.expand(3, 2, 5)
    assert clean(labels, image, max_regions=4) == [1, 2, 3, 0, 0]
    assert clean(labels, image, max_regions=1) == [0] * 5


@pytest.mark.parametrize("offset", [-2, -1, 0, 1, 2])
def test_contours_snap_to_edges(offset: int) -> None:
    labels = (torch.arange(40) >= 20 + offset).long().expand(20, 40)
    assert clean(labels, STEP, snap=2) == [0] * 20 + [1] * 20


def test_blur_is_dissolved_and_lines_stay() -> None:
    labels = torch.tensor([0] * 18 + [1] * 4 + [2] * 18).expand(20, 40)
    ramp = torch.cat([torch.zeros(18), torch.linspace(0, 1, 4), torch.ones(18)]).expand(3, 20, 40)
    line = STEP.clone()
    line[:, :, 18:22] = torch.tensor([1.0, 0.0, 0.0])[:, None, None]
    assert set(clean(labels, ramp, snap=2)) == {0, 1}
    assert clean(labels, line, snap=2) == [0] * 18 + [2] * 4 + [1] * 18
    stripes = torch.arange(12) // 2
    assert clean(stripes.expand(10, 12), torch.linspace(0, 1, 12).expand(3, 10, 12), snap=2) == stripes.tolist()


@given(MAPS, st.integers(1, 8))
@settings(max_examples=40)
def test_no_small_piece_stays(labels: Any, min_size: int) -> None:
    areas = np.bincount(connect(merge_small(labels, min_size)).ravel())
    assert len(areas) == 1 or areas.min() >= min_size


@given(MAPS, st.integers(1, 6), st.integers(0, 3))
@settings(max_examples=40)
def test_any_map(labels: Any, most: int, snap: int) -> None:
    image = torch.rand(3, *labels.shape, generator=torch.Generator().manual_seed(0))
    result = Cleanup(snap=snap, max_regions=most).apply(image, labels).labels
    areas = result.flatten().bincount()
    assert len(areas) <= most and (areas > 0).all() and (areas[:-1] >= areas[1:]).all()


def test_scores_are_means_and_names_majorities() -> None:
    classes = (torch.arange(30) >= 12).long().repeat(20, 1) * 2
    classes[5, 20] = 1  # a speck
    scores = torch.where(classes > 0, 0.5, float("nan"))
    result = Cleanup().apply(torch.zeros(3, 20, 30), Prediction(classes, scores, ["sky", "bird", "dog"]))
    assert result.names == {0: "dog", 1: "sky"}
    assert result.scores is not None and result.scores.tolist() == pytest.approx([0.5, float("nan")], nan_ok=True)
