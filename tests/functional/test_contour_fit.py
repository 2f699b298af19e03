"""choose_softness and contour_gain: edges blurred by a known amount, flat graphics, photos, and bad arguments."""

import itertools
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from kcgs import RegionMap
from kcgs.data import chart_2x3, chart_pie, load_image, load_labels
from kcgs.functional import choose_softness, contour_fit, contour_windows
from kcgs.functional.contour_fit import contour_gain

COLORS = torch.tensor([[0.2, 0.3, 0.6], [0.8, 0.6, 0.3]])
SIZE = (100, 120)
ONE = torch.zeros(4, 4).long()


def ellipse(scale: int = 1) -> Tensor:
    """Label map of an ellipse, at `scale` times the size."""
    y, x = torch.meshgrid(*((torch.arange(n * scale) + 0.5) / scale for n in SIZE), indexing="ij")
    return (((x - 60) / 40) ** 2 + ((y - 48) / 30) ** 2 < 1).long()


def paint(labels: Tensor, softness: float = 0.0, colors: Tensor = COLORS) -> Tensor:
    """Mix flat colours by the memberships of that softness: the renderer's own definition."""
    regions = RegionMap(labels, softness)
    memberships = torch.stack([regions.membership(region, torch.float32) for region in regions.ids.tolist()])
    return torch.einsum("rhw,rc->chw", memberships, colors)


def grain(noise: float, seed: int = 0) -> Tensor:
    """White noise, and texture of a few pixels' size and the same strength."""
    generator = torch.Generator().manual_seed(seed)
    white, coarse = (torch.randn(3, *SIZE, generator=generator) for _ in range(2))
    return noise * (white + 3 * F.avg_pool2d(coarse, 3, 1, 1))


def frame(root: Path, name: str) -> tuple[Tensor, Tensor]:
    folder = root / "DAVIS"
    if not folder.is_dir():
        pytest.skip(f"no DAVIS in {root}")
    image = load_image(folder / f"JPEGImages/480p/{name}/00000.jpg")
    return image.reshape(image.shape[-3:]), load_labels(folder / f"Annotations/480p/{name}/00000.png")


class TestChooseSoftness:
    @pytest.mark.parametrize(("softness", "noise"), [(0.0, 0.02), (0.5, 0.0), (1.2, 0.02), (2.0, 0.02)])
    def test_blurred_edge(self, softness: float, noise: float) -> None:
        labels = ellipse()
        image = paint(labels, softness) + grain(noise)
        assert choose_softness(image, labels) == {(0, 1): pytest.approx(softness, abs=0.1)}

    def test_strong_texture(self) -> None:
        labels = ellipse()
        values = [choose_softness(paint(labels, 1.0) + grain(0.06, seed), labels)[0, 1] for seed in range(2)]
        assert all(0.8 <= value <= 1.25 for value in values)

    def test_antialiased_edges_are_narrow(self) -> None:
        assert 0.0 < choose_softness(F.avg_pool2d(paint(ellipse(4)), 4), ellipse())[0, 1] <= 0.6
        assert all(0.3 <= value <= 0.6 for value in choose_softness(*chart_pie()).values())

    def test_hard_contours(self) -> None:
        """Shading is no blur, and a flat image takes the least softness."""
        ramp = torch.linspace(0, 0.5, SIZE[1]) - torch.linspace(0, 0.3, SIZE[0])[:, None]
        assert choose_softness(paint(ellipse()) + ramp, ellipse()) == {(0, 1): 0.0}
        assert choose_softness(torch.full((3, *SIZE), 0.4), ellipse()) == {(0, 1): 0.0}
        chart = choose_softness(*chart_2x3())
        assert len(chart) == 7 and set(chart.values()) == {0.0}

    def test_pairs(self) -> None:
        """0 | 1 is hard, 1 | 2 soft."""
        labels = torch.arange(90).div(30, rounding_mode="floor").repeat(40, 1)
        image = paint(labels, 1.4, torch.tensor([[0.1], [0.5], [0.9]]))
        image[..., :45] = torch.tensor([0.1, 0.5]).repeat_interleave(30)[:45]
        assert choose_softness(image, labels) == {(0, 1): 0.0, (1, 2): pytest.approx(1.4, abs=0.1)}
        labels = torch.tensor([[7, 7, 2], [0, 7, 2**40]]).repeat_interleave(8, 0).repeat_interleave(8, 1)
        assert set(choose_softness(torch.rand(1, 16, 24), labels)) == {(2, 7), (0, 7), (2, 2**40), (7, 2**40)}

    def test_thin_region(self) -> None:
        labels = torch.zeros(60, 60, dtype=torch.int64)
        labels[:, 29:32] = 1
        assert choose_softness(paint(labels, 1.0), labels) == {(0, 1): pytest.approx(1.0, abs=0.1)}

    def test_short_contours_take_the_common_softness(self) -> None:
        labels = ellipse()
        image = paint(labels, 1.4)
        labels[2:4, 2:4] = 5  # 8 pixel edges, flat on both sides: by itself it would be 0
        softness = choose_softness(image, labels)
        assert softness[0, 5] == softness[0, 1] == pytest.approx(1.4, abs=0.1)

    @pytest.mark.parametrize("size", [(1, 2), (3, 3)])
    def test_tiny(self, size: tuple[int, int]) -> None:
        labels = torch.arange(size[0] * size[1]).reshape(size)
        values = set(choose_softness(torch.rand(3, *size), labels).values())
        assert values <= set(itertools.chain(contour_fit.CANDIDATES, (n * 0.05 for n in range(57))))

    def test_dtype_contrast_and_colour_do_not_matter(self) -> None:
        labels, image = ellipse(), paint(ellipse(), 1.0)
        expected = choose_softness(image, labels)
        assert choose_softness(image.double().requires_grad_(), labels.to(torch.uint8)) == expected
        assert choose_softness(0.3 + 0.2 * image, labels) == choose_softness(1 - image, labels) == expected

    def test_candidates(self) -> None:
        labels, image = ellipse(), paint(ellipse(), 1.0)
        assert choose_softness(image, labels, candidates=[2.0]) == {(0, 1): 2.0}
        assert choose_softness(image, labels, candidates=(1.1, 0.0, 1.1)) == {(0, 1): 1.1}
        wide = choose_softness(paint(labels, 5.0), labels, candidates=(1.0, 5.0, 12.0))
        assert wide[0, 1] == pytest.approx(5.0, abs=0.5)

    def test_long_contours_are_sampled(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(contour_windows, "_PAIR_WINDOWS", 10)
        assert choose_softness(paint(ellipse(), 1.0), ellipse()) == {(0, 1): pytest.approx(1.0, abs=0.1)}

    def test_a_photo(self, data_root: Path) -> None:
        # 400 Gaussians fitted to a crop at eight fixed values are best along the contour within these, over two seeds
        (softness,) = choose_softness(*frame(data_root, "dog")).values()
        assert 1.2 <= softness <= 1.6

    @pytest.mark.parametrize(
        ("change", "error", "words"),
        [
            ({"image": torch.zeros(3, 4, 4).long()}, TypeError, "image .* floating"),
            ({"image": torch.zeros(1, 3, 4, 4)}, ValueError, "image must have 3 dim"),
            ({"image": torch.zeros(3, 4, 5)}, ValueError, r"image .*\(C, 4, 4\).*\(3, 4, 5\)"),
            ({"image": torch.full((3, 4, 4), torch.nan)}, ValueError, "image must be finite"),
            ({"labels": ONE + 0.5}, ValueError, "labels must hold whole numbers"),
            ({"labels": ONE[None]}, ValueError, "labels must have 2 dim"),
            ({"candidates": ()}, ValueError, "candidates .* one or more"),
            ({"candidates": (-1.0,)}, ValueError, "candidates .* in"),
            ({"candidates": ("1",)}, TypeError, "candidates must be a number"),
            ({"candidates": 1.0}, TypeError, "candidates must be a sequence"),
        ],
    )
    def test_exception(self, change: dict[str, object], error: type[Exception], words: str) -> None:
        with pytest.raises(error, match=words):
            choose_softness(**{"image": torch.zeros(3, 4, 4), "labels": ONE, **change})


class TestContourGain:
    def test_an_edge_gains_and_none_does_not(self) -> None:
        edge = contour_gain(paint(ellipse(), 1.0) + grain(0.01), ellipse())[0, 1]
        assert edge.smooth_error > 10 * edge.contour_error and edge.share > 0.9
        flat = torch.full((3, *SIZE), 0.4)
        assert abs(contour_gain(flat + grain(0.01), ellipse())[0, 1].share) < 0.1
        assert contour_gain(flat, ellipse())[0, 1].share == 0.0

    def test_is_a_mean_over_pixels_and_channels(self) -> None:
        noise = grain(0.02)
        gain = contour_gain(paint(ellipse()) + noise, ellipse())[0, 1]
        assert gain.contour_error == pytest.approx(float(noise.var()), rel=0.3)

    @pytest.mark.parametrize("function", [choose_softness, contour_gain])
    def test_one_region(self, function: object) -> None:
        for size in ((9, 7), (1, 1)):
            assert function(torch.rand(3, *size), torch.full(size, 3)) == {}

    def test_a_contour_against_a_displaced_one(self, data_root: Path) -> None:
        image, labels = frame(data_root, "blackswan")
        maps = (labels, labels.roll((40, 40), (0, 1)))
        (contour,), (displaced,) = (contour_gain(image, map).values() for map in maps)
        assert contour.share > 0.1 and displaced.share < 0.05
