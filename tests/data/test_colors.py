"""Label maps in colours."""

from typing import Any

import pytest
import torch
from skimage.color import rgb2lab

from kcgs.data import colorize_labels, label_colors


class TestLabelColors:
    def test_range_and_order(self) -> None:
        colors = label_colors(4096)
        assert colors.dtype == torch.float32 and 0 <= colors.min() <= colors.max() <= 1
        assert torch.equal(label_colors(7), colors[:7]) and label_colors(0).shape == (0, 3)

    def test_colors_differ(self) -> None:
        assert len((label_colors(256) * 255).round().unique(dim=0)) == 256
        assert len(label_colors(4096).unique(dim=0)) == 4096
        lab = torch.from_numpy(rgb2lab(label_colors(12).numpy()))
        assert (torch.cdist(lab, lab) + 1000 * torch.eye(12)).min() > 15

    @pytest.mark.parametrize(("n", "message"), [(1.0, "an integer"), (True, "an integer"), (-1, "at least 0; got -1")])
    def test_bad_number(self, n: Any, message: str) -> None:
        with pytest.raises((TypeError, ValueError), match=f"n must be {message}"):
            label_colors(n)


class TestColorizeLabels:
    def test_any_ids(self) -> None:
        image = colorize_labels(torch.tensor([[0, 255, 10**12], [255, 255, 0]]))
        assert torch.equal(image, label_colors(3)[torch.tensor([[0, 1, 2], [1, 1, 0]])].permute(2, 0, 1))

    @pytest.mark.parametrize("labels", [torch.full((2, 2), 0.5), torch.tensor([[-1]])])
    def test_bad_labels(self, labels: torch.Tensor) -> None:
        with pytest.raises((TypeError, ValueError), match="labels must"):
            colorize_labels(labels)
