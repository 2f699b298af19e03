"""Smooth contours: straight edges come back, labels stay, bad input is refused."""

from __future__ import annotations

import pytest
import torch

from kcgs import RegionMap
from kcgs.functional import smooth_contours


def tilted(size: int, scale: int = 1) -> torch.Tensor:
    at = (torch.arange(size * scale) + 0.5) / scale
    return (at[None, :] * 0.3 + at[:, None] > 0.65 * size).long()


def coverage(fine: torch.Tensor, k: int) -> torch.Tensor:
    height, width = fine.shape
    return fine.double().view(height // k, k, width // k, k).mean((1, 3))


def test_a_slanted_edge_comes_back() -> None:
    exact = coverage(tilted(40, 16), 16)
    stairs = tilted(40).double()
    smooth = coverage(smooth_contours(tilted(40), 8), 8)
    inside = (slice(8, -8), slice(8, -8))
    assert (smooth - exact)[inside].abs().max() < 0.12
    assert (smooth - exact)[inside].abs().mean() < 0.25 * (stairs - exact)[inside].abs().mean()


def test_flat_maps_and_ids_stay() -> None:
    labels = torch.full((6, 8), 9)
    assert torch.equal(smooth_contours(labels, 2), torch.full((12, 16), 9))
    three = torch.tensor([3, 70, 1]).repeat_interleave(8).expand(24, -1)
    fine = smooth_contours(three, 4)
    assert fine.unique().tolist() == [1, 3, 70]
    assert torch.equal(RegionMap.from_labels(fine, supersample=4).labels, three)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"supersample": 1}, r"supersample must be in \[2, 16\]; got 1"),
        ({"supersample": 2.0}, "supersample must be an integer"),
        ({"sigma": 0.0}, "sigma must be in"),
        ({"labels": torch.zeros(1, 4, 4).long()}, "labels must have 2 dimensions"),
        ({"labels": -torch.ones(4, 4).long()}, "labels"),
    ],
)
def test_errors(change: dict[str, object], words: str) -> None:
    with pytest.raises((TypeError, ValueError), match=words):
        smooth_contours(**{"labels": torch.zeros(4, 4).long(), **change})  # type: ignore[arg-type]
