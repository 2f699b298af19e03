"""Edge alignment against what can be counted by hand."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

from kcgs.data import Davis, load_image, load_labels
from kcgs.functional import edge_alignment, edge_alignment_map, edge_band


def halves(height: int, width: int, at: int) -> Tensor:
    return (torch.arange(width) >= at).long().expand(height, width)


class TestEdgeAlignment:
    def test_on_and_off_an_edge(self) -> None:
        image = torch.where(halves(40, 80, 40).bool(), 0.9, 0.2).expand(3, -1, -1)
        maps = torch.stack([halves(40, 80, at) for at in (40, 41, 46, 60)])
        on, beside, off, flat = edge_alignment(image.expand(4, -1, -1, -1), maps).tolist()
        assert (on, beside) == (1.0, 1.0)
        assert off < 0.51 and flat == pytest.approx(0.5)

    def test_noise_is_chance(self) -> None:
        noise = torch.rand(3, 160, 200, generator=torch.Generator().manual_seed(0))
        assert edge_alignment(noise, halves(160, 200, 90)) == pytest.approx(0.5, abs=0.05)

    def test_contrast_does_not_matter(self) -> None:
        image = torch.rand(1, 60, 60, generator=torch.Generator().manual_seed(0)) + 2.0 * halves(60, 60, 30)
        figure = edge_alignment(image, halves(60, 60, 30))
        assert edge_alignment(image * 0.1, halves(60, 60, 30)) == pytest.approx(float(figure), abs=1e-4)

    def test_map_is_on_the_contours(self) -> None:
        labels = halves(30, 50, 20)
        image = torch.rand(3, 30, 50, generator=torch.Generator().manual_seed(1)).half()
        ranks = edge_alignment_map(image, labels)
        assert ranks.dtype == torch.float32
        assert torch.equal(ranks.isfinite(), edge_band(labels, 1))
        assert ranks.nanmean() == edge_alignment(image, labels)

    def test_no_contour_or_nothing_to_compare_with(self) -> None:
        assert edge_alignment(torch.zeros(3, 9, 9), torch.zeros(9, 9).long()).isnan()
        stripes = (torch.arange(30) // 2).expand(20, 30)
        assert edge_alignment(torch.rand(3, 20, 30), stripes).isnan()
        assert edge_alignment(torch.zeros(3, 1, 1), torch.zeros(1, 1).long()).isnan()

    @pytest.mark.parametrize(
        ("image", "labels", "error"),
        [
            (torch.zeros(3, 4, 4), torch.zeros(4, 5).long(), ValueError),
            (torch.zeros(2, 3, 4, 4), torch.zeros(4, 4).long(), ValueError),
            (torch.zeros(3, 4, 4).long(), torch.zeros(4, 4).long(), TypeError),
            (torch.zeros(3, 4, 4), torch.zeros(4, 4), TypeError),
        ],
    )
    def test_errors(self, image: Tensor, labels: Tensor, error: type[Exception]) -> None:
        with pytest.raises(error, match="(image|labels) must have"):
            edge_alignment(image, labels)

    def test_human_maps_against_their_mirror_images(self, data_root: Path) -> None:
        pairs = [
            (load_image(folder / "image.jpg"), load_labels(folder / "mask.png"))
            for folder in sorted((data_root / "bsds").glob("*"))[::3]
        ]
        if (data_root / "DAVIS").is_dir():
            frames = Davis(data_root / "DAVIS")
            pairs += [(frames[at].image, frames[at].labels) for at in range(0, len(frames), 6)]
        if not pairs:
            pytest.skip(f"no photos with masks in {data_root}")
        for image, labels in pairs:
            assert edge_alignment(image, labels) > 0.62
            assert edge_alignment(image, labels.flip(1)) < 0.55
