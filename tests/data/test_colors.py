"""Label maps in colours."""

import pytest
import torch
from skimage.color import rgb2lab

from kcgs.data import colorize_labels, label_colors, overlay_labels
from kcgs.maps import interior_points, touching_pairs


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

    def test_bad_number(self) -> None:
        with pytest.raises(ValueError, match="n must be at least 0; got -1"):
            label_colors(-1)


class TestColorizeLabels:
    def test_any_ids(self) -> None:
        image = colorize_labels(torch.tensor([[0, 255, 10**12], [255, 255, 0]]))
        assert torch.equal(image, label_colors(3)[torch.tensor([[0, 1, 2], [1, 1, 0]])].permute(2, 0, 1))

    def test_bad_labels(self) -> None:
        with pytest.raises(ValueError, match="labels must hold non-negative ids"):
            colorize_labels(torch.tensor([[-1]]))


class TestOverlay:
    def test_touching_regions_differ_in_colour(self) -> None:
        places = torch.rand(60, 2, generator=torch.Generator().manual_seed(0)) * 240
        y, x = torch.meshgrid(torch.arange(240.0), torch.arange(240.0), indexing="ij")
        labels = torch.cdist(torch.stack([x, y], -1).view(-1, 2), places).argmin(1).view(240, 240)
        (x, y), distances = interior_points(labels)[0].T, interior_points(labels)[1]
        colors = overlay_labels(torch.full((3, 240, 240), 0.5), labels)[:, y, x].T
        pairs = torch.tensor([(a, b) for a, b in touching_pairs(labels) if min(distances[a], distances[b]) >= 4])
        assert len(pairs) > 100 and ((colors[pairs[:, 0]] - colors[pairs[:, 1]]).abs().amax(1) > 0.02).all()

    def test_ids_are_written_where_there_is_room(self) -> None:
        labels = torch.full((60, 90), 7)
        labels[:, 50:], labels[:3] = 123, 4
        image = torch.full((3, 60, 90), 0.5)
        differs = (overlay_labels(image, labels, ids=True) - overlay_labels(image, labels)).abs().amax(0) > 0.1
        assert all(differs[labels == region].any() == (region != 4) for region in (4, 7, 123))


def test_interior_points_lie_in_their_regions() -> None:
    """Also in a ring, whose centre is not in it."""
    y, x = torch.meshgrid(torch.arange(40) - 20, torch.arange(60) - 30, indexing="ij")
    radius = (x**2 + y**2) ** 0.5
    labels = ((radius > 8).long() + (radius > 16)) % 3
    points, distances = interior_points(labels)
    assert labels[points[:, 1], points[:, 0]].tolist() == [0, 1, 2]
    assert distances[0] == pytest.approx(8, abs=1) and distances[1] == pytest.approx(4.5, abs=1)
