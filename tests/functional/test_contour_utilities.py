"""Coverage, boundary score and edge alignment against what can be counted by hand or by brute force."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from kcgs import RegionMap
from kcgs.data import Davis, load_image, load_labels
from kcgs.functional import (
    boundary_f_score,
    coverage,
    edge_alignment,
    edge_alignment_map,
    edge_band,
    polygon_coverage,
    polygon_labels,
)

SQUARE = torch.tensor([[1.25, 0.5], [3.5, 0.5], [3.5, 2.25], [1.25, 2.25]], dtype=torch.float64)


def star(seed: int, vertices: int = 7) -> Tensor:
    """A polygon round (8, 6) that does not cross itself; parts of it leave 12 x 16 pixels."""
    generator = torch.Generator().manual_seed(seed)
    angle = (torch.rand(vertices, generator=generator, dtype=torch.float64) * 2 * math.pi).sort().values
    radius = torch.rand(vertices, generator=generator, dtype=torch.float64) * 9 + 1
    return torch.stack([8 + radius * angle.cos(), 6 + radius * angle.sin()], 1)


def halves(height: int, width: int, at: int) -> Tensor:
    return (torch.arange(width) >= at).long().expand(height, width)


class TestPolygonCoverage:
    def test_square_by_hand(self) -> None:
        expected = torch.outer(torch.tensor([0.5, 1, 0.25]), torch.tensor([0, 0.75, 1, 0.5, 0])).double()
        both = polygon_coverage([SQUARE, SQUARE.flip(0)], (3, 5))
        assert torch.equal(both, expected.expand(2, -1, -1))

    @pytest.mark.parametrize("seed", range(6))
    def test_dense_supersampling(self, seed: int) -> None:
        outline = star(seed)
        at = (torch.arange(16 * 64, dtype=torch.float64) + 0.5) / 64
        x, y = at, at[: 12 * 64, None]
        inside = torch.zeros(12 * 64, 16 * 64, dtype=torch.bool)
        for (x0, y0), (x1, y1) in zip(outline, outline.roll(-1, 0), strict=True):
            inside ^= ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
        dense = inside.double().view(12, 64, 16, 64).mean((1, 3))
        exact = polygon_coverage([outline], (12, 16))[0]
        assert (exact - dense).abs().max() < 0.006 and (exact - dense).mean().abs() < 1e-4
        assert exact.min() > -1e-12 and exact.max() < 1 + 1e-12
        assert (polygon_coverage([outline.float()], (12, 16))[0] - exact).abs().max() < 3e-6

    @pytest.mark.parametrize("seed", range(3))
    def test_gradcheck(self, seed: int) -> None:
        outline = star(seed, vertices=5).requires_grad_()
        assert torch.autograd.gradcheck(lambda vertices: polygon_coverage([vertices], (12, 16)), outline)

    def test_gradcheck_of_level_and_upright_edges(self) -> None:
        square = (SQUARE + torch.tensor([0.1, 0.1])).requires_grad_()
        assert torch.autograd.gradcheck(lambda vertices: polygon_coverage(vertices[None], (3, 5)), square)

    def test_gradient_of_the_area(self) -> None:
        square = SQUARE.clone().requires_grad_()
        polygon_coverage([square], (4, 6)).sum().backward()
        # half the diagonal's normal: what the shoelace formula gives
        assert square.grad is not None
        assert torch.allclose(square.grad[0], torch.tensor([-1.75, -2.25], dtype=torch.float64) / 2)

    def test_area_is_kept_under_shifts(self) -> None:
        for shift in torch.linspace(0, 1, 7, dtype=torch.float64):
            assert polygon_coverage([SQUARE + shift], (5, 7)).sum() == pytest.approx(2.25 * 1.75, abs=1e-12)

    def test_far_outside(self) -> None:
        frame = torch.tensor([[-1e6, -1e6], [1e6, -1e6], [1e6, 1e6], [-1e6, 1e6]])
        shares = polygon_coverage(torch.stack([frame, frame + 3e6, frame - 3e6]), (3, 4))
        assert torch.equal(shares[0], torch.ones(3, 4)) and (shares[1:] == 0).all()

    def test_partition_adds_up_and_a_fit_finds_the_vertices(self) -> None:
        corner = torch.tensor([5.3, 4.7], dtype=torch.float64)
        rim = torch.tensor([[0.0, 0], [12, 0], [12, 10], [0, 10]], dtype=torch.float64)
        parts = [torch.stack([rim[k], rim[(k + 1) % 4], corner]) for k in range(4)]
        shares = polygon_coverage(parts, (10, 12))
        assert torch.allclose(shares.sum(0), torch.ones(10, 12, dtype=torch.float64))
        guess = torch.tensor([6.5, 3.5], dtype=torch.float64, requires_grad=True)
        optimizer = torch.optim.Adam([guess], lr=0.1)
        for _ in range(80):
            optimizer.zero_grad()
            drawn = polygon_coverage([torch.stack([rim[0], rim[1], guess])], (10, 12))
            (drawn - shares[:1]).square().sum().backward()
            optimizer.step()
        assert (guess - corner).abs().max() < 0.02

    @pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32])
    def test_dtype(self, dtype: torch.dtype) -> None:
        assert polygon_coverage([SQUARE.to(dtype)], (3, 5)).dtype == dtype

    @pytest.mark.parametrize(
        ("polygons", "error", "words"),
        [
            ([], ValueError, "at least one polygon"),
            ([SQUARE[:2]], ValueError, "at least 3 vertices"),
            ([SQUARE, SQUARE.float()], ValueError, "one dtype and device"),
            ([SQUARE.long()], TypeError, "real floating dtype"),
            ([SQUARE * math.nan], ValueError, "must be finite"),
            (SQUARE, ValueError, "must have 3 dimensions"),
            ([torch.zeros(4, 3)], ValueError, "last|shape"),
            ([[0.0, 1.0]], TypeError, "must be a Tensor"),
        ],
    )
    def test_errors(self, polygons: list[Tensor], error: type[Exception], words: str) -> None:
        for function in (polygon_coverage, polygon_labels):
            with pytest.raises(error, match=words):
                function(polygons, (3, 5))


class TestPolygonLabels:
    def test_region_map_has_the_shares(self) -> None:
        labels = polygon_labels([star(1), star(2, 4)], (12, 16), 16)
        regions = RegionMap.from_labels(labels, supersample=16)
        assert regions.size == (12, 16) and labels.shape == (192, 256)
        last = coverage(labels, 16)[2]
        assert (last - polygon_coverage([star(2, 4)], (12, 16))[0].float()).abs().max() < 0.05

    def test_common_edges_leave_no_gap_and_later_ones_lie_above(self) -> None:
        left = torch.tensor([[0.0, 0], [2.5, 0], [2.5, 4], [0, 4]])
        right = torch.tensor([[2.5, 0], [6, 0], [6, 4], [2.5, 4]])
        assert polygon_labels([left, right], (4, 6)).unique().tolist() == [1, 2]
        assert polygon_labels([right, left + 1.0], (4, 6))[2, 3] == 2

    @pytest.mark.parametrize(("supersample", "error"), [(0, ValueError), (2.0, TypeError), (9999, ValueError)])
    def test_bad_supersample(self, supersample: int, error: type[Exception]) -> None:
        with pytest.raises(error, match="supersample must be"):
            polygon_labels([SQUARE], (3, 5), supersample)


class TestCoverage:
    def test_batch_and_sum(self) -> None:
        labels = torch.randint(0, 4, (2, 12, 20), generator=torch.Generator().manual_seed(0)) * 7
        shares = coverage(labels, 4)
        assert shares.shape == (2, 4, 3, 5)
        assert torch.equal(shares.sum(1), torch.ones(2, 3, 5))
        assert shares[1, 2, 0, 1] == (labels[1, :4, 4:8] == 14).float().mean()
        assert torch.equal(coverage(labels[0], 1).argmax(0) * 7, labels[0])

    @pytest.mark.parametrize(("factor", "error"), [(0, ValueError), (3, ValueError), (2.0, TypeError)])
    def test_errors(self, factor: int, error: type[Exception]) -> None:
        with pytest.raises(error, match="factor must be"):
            coverage(torch.zeros(4, 4).long(), factor)


class TestBoundaryFScore:
    def test_shifts_by_hand(self) -> None:
        maps = torch.stack([halves(10, 40, at) for at in (20, 22, 23)])
        score = boundary_f_score(maps, halves(10, 40, 20).expand(3, -1, -1))
        assert score.f.tolist() == [1.0, 1.0, 0.0]
        assert boundary_f_score(maps[2], maps[0], tolerance=3).f == 1

    def test_missing_and_superfluous_contours(self) -> None:
        one, two = halves(10, 40, 10), halves(10, 40, 10) + halves(10, 40, 30)
        score = boundary_f_score(two, one)
        assert (score.precision, score.recall) == (0.5, 1.0)
        assert score.f == pytest.approx(2 / 3)
        back = boundary_f_score(one, two)
        assert (back.precision, back.recall) == (1.0, 0.5)

    def test_maps_without_boundary(self) -> None:
        flat, cut = torch.zeros(6, 9).long(), halves(6, 9, 4)
        assert tuple(map(float, boundary_f_score(flat, flat + 3))) == (1.0, 1.0, 1.0)
        assert tuple(map(float, boundary_f_score(flat, cut))) == (1.0, 0.0, 0.0)
        assert tuple(map(float, boundary_f_score(cut, flat))) == (0.0, 1.0, 0.0)

    def test_agrees_with_dilation(self) -> None:
        """The evaluation of DAVIS dilates by a disk: the same as a distance within its radius."""
        from scipy.ndimage import binary_dilation
        from skimage.morphology import disk

        generator = torch.Generator().manual_seed(0)
        blobs = [torch.nn.functional.avg_pool2d(torch.rand(1, 60, 80, generator=generator), 9, 1, 4) for _ in range(2)]
        mine, other = ((blob[0] > 0.5).long() for blob in blobs)

        def boundary(labels: Tensor) -> Tensor:
            right, down = labels.roll(-1, 1), labels.roll(-1, 0)
            right[:, -1], down[-1] = labels[:, -1], labels[-1]
            across = down.roll(-1, 1)
            across[:, -1] = down[:, -1]
            return (labels != right) | (labels != down) | (labels != across)

        first, second = boundary(mine).numpy(), boundary(other).numpy()
        score = boundary_f_score(mine, other, tolerance=3)
        assert score.precision == pytest.approx(binary_dilation(second, disk(3))[first].mean())
        assert score.recall == pytest.approx(binary_dilation(first, disk(3))[second].mean())

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            ({"reference": torch.zeros(4, 5).long()}, "reference must have the shape"),
            ({"tolerance": -1.0}, "tolerance must be"),
            ({"tolerance": math.inf}, "tolerance must be"),
        ],
    )
    def test_errors(self, change: dict[str, object], words: str) -> None:
        arguments = {"labels": torch.zeros(4, 4).long(), "reference": torch.zeros(4, 4).long(), **change}
        with pytest.raises(ValueError, match=words):
            boundary_f_score(**arguments)  # type: ignore[arg-type]


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
