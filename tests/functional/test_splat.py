"""region_splat: the hand-worked table, every backend against float64, gradients, exactness, extremes."""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from kcgs import GaussianField, RegionMap, RegionSplatRenderer
from kcgs.functional import region_splat
from kcgs.kernels.whitened import LEAST_SCALE
from tests.tester import BaseTester

# scenes here are drawn at random, with ids that their maps may lack
pytestmark = pytest.mark.filterwarnings("ignore:.* Gaussians paint nothing:UserWarning")


class Scene(NamedTuple):
    means: Tensor
    cholesky: Tensor
    colors: Tensor
    region_ids: Tensor
    labels: Tensor


def random_scene(n: int, size: tuple[int, int], regions: int, *, channels: int = 3, seed: int = 0) -> Scene:
    """Draw a float64 scene whose label map has blocks and a disc."""
    generator = torch.Generator().manual_seed(seed)
    height, width = size

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    means = uniform(n, 2) * torch.tensor([width, height]) * 1.2 - 0.1 * torch.tensor([width, height])
    sigma = 0.6 * math.sqrt(height * width / max(n, 1)) + 0.3
    cholesky = torch.stack([sigma * (0.3 + uniform(n)), sigma * (uniform(n) - 0.5), sigma * (0.3 + uniform(n))], -1)
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    labels = (x * 3 // max(width, 1) + 3 * (y * 2 // max(height, 1))) % max(1, regions - 1)
    if regions > 1:
        disc = (x - width / 2) ** 2 + (y - height / 2) ** 2 < (min(height, width) / 3) ** 2
        labels = torch.where(disc, regions - 1, labels)
    ids = torch.randint(0, regions, (n,), generator=generator)
    return Scene(means, cholesky, uniform(n, channels) - 0.3, 10 * ids, 10 * labels)


def on(device: torch.device, dtype: torch.dtype, scene: Scene) -> Scene:
    return Scene(*(t.to(device, dtype) for t in scene[:3]), *(t.to(device) for t in scene[3:]))


def as_float32(scene: Scene) -> Scene:
    return Scene(*(t.float() for t in scene[:3]), *scene[3:])


def gradients(scene: Scene, regions: RegionMap | None, **options: object) -> tuple[Tensor, list[Tensor]]:
    inputs = [t.detach().clone().requires_grad_() for t in scene[:3]]
    size = None if regions is not None else tuple(scene.labels.shape)
    region_ids = None if regions is None else scene.region_ids
    image = region_splat(*inputs, region_ids, regions, size=size, **options)
    probe = torch.linspace(-1, 2, image.numel(), dtype=image.dtype).view_as(image)
    return image.detach(), list(torch.autograd.grad((image * probe).sum(), inputs))


def assert_gradients_close(actual: list[Tensor], expected: list[Tensor], tolerance: float) -> None:
    """Compare as values and, as an error in scale or direction would hide in large values, as vectors."""
    for result, exact in zip(actual, expected, strict=True):
        scale = exact.abs().max().clamp_min(1e-30)
        assert ((result.double() - exact.double()).abs().max() / scale) <= tolerance
        cosine = torch.nn.functional.cosine_similarity(result.double().flatten(), exact.double().flatten(), dim=0)
        assert cosine >= 1 - tolerance


class TestRegionSplat(BaseTester):
    def test_smoke(self, backend: str, device: torch.device, dtype: torch.dtype) -> None:
        image = region_splat(*on(device, dtype, random_scene(40, (20, 30), 3)), backend=backend)
        assert image.dtype == dtype and image.device.type == device.type
        assert image.isfinite().all() and image.any()

    @pytest.mark.parametrize("lead", [(), (3,)])
    @pytest.mark.parametrize(("count", "channels"), [(0, 3), (7, 5)])
    def test_cardinality(
        self, backend: str, device: torch.device, dtype: torch.dtype, lead: tuple[int, ...], count: int, channels: int
    ) -> None:
        scene = on(device, dtype, random_scene(count, (9, 17), 3, channels=channels))
        tensors = [t.expand(*lead, *t.shape) for t in scene[:4]]
        for maps in (scene.labels, scene.labels.expand(*lead, 9, 17)):
            image = region_splat(*tensors, maps, backend=backend)
            assert image.shape == (*lead, channels, 9, 17) and bool(image.any()) == (count > 0)

    @pytest.mark.parametrize(
        ("change", "error", "words"),
        [
            ({"means": [[0.0, 0.0]]}, TypeError, "means must be a Tensor; got list"),
            ({"means": torch.zeros(2, 2).long()}, TypeError, "means must have a real floating dtype; got torch.int64"),
            ({"means": torch.zeros(2, 3)}, ValueError, r"means must have shape \(..., 2\); got \(2, 3\)"),
            ({"means": torch.full((2, 2), math.nan)}, ValueError, "means must be finite, .*; got 4 NaN"),
            ({"means": torch.full((2, 2), 1e9)}, ValueError, r"within 1e\+08 pixels; got \[1e\+09, 1e\+09\]"),
            ({"cholesky": torch.tensor([[1.0, 0.0, -1.0]] * 2)}, ValueError, r"got l11 and l22 in \[-1, 1\]"),
            ({"cholesky": torch.tensor([[1e-7, 0.0, 1.0]] * 2)}, ValueError, r"got l11 and l22 in \[1e-07, 1\]"),
            ({"cholesky": torch.ones(3, 3)}, ValueError, r"cholesky must have shape \(2, 3\); got \(3, 3\)"),
            ({"colors": torch.zeros(2, 0)}, ValueError, "at least one channel"),
            ({"colors": torch.full((2, 3), math.inf)}, ValueError, "colors must be finite"),
            ({"region_ids": None}, TypeError, "region_ids must be a Tensor"),
            ({"region_ids": torch.tensor([0.0, 1.0])}, TypeError, "region_ids must have an integer dtype"),
            ({"region_ids": torch.tensor([0, -1])}, ValueError, "region_ids must be non-negative; got -1"),
            ({"region_ids": torch.tensor([0])}, ValueError, r"region_ids must have shape \(2,\); got \(1,\)"),
            ({"regions": torch.tensor([[0.0, 1.5]])}, ValueError, "regions must hold whole numbers; got 1.5"),
            ({"regions": torch.zeros(2, 3, 3).long()}, ValueError, "regions must hold 1 map"),
            ({"regions": "map.png"}, TypeError, r"got str: RegionMap\(regions\) reads it"),
            ({"regions": None}, ValueError, "regions must be given with region_ids; got None"),
            ({"regions": None, "region_ids": None}, ValueError, "size must be given"),
            ({"regions": None, "size": (0, 4)}, ValueError, "size must be at least 1 x 1"),
            ({"regions": None, "size": (2.0, 4)}, TypeError, "size must hold two integers"),
            ({"size": (2, 2)}, ValueError, r"size must equal the size of regions, \(1, 2\); got \(2, 2\)"),
            ({"cutoff": 1.0}, ValueError, r"cutoff must be in \[0, 1\); got 1.0"),
            ({"backend": "gpu"}, ValueError, "backend must be one of auto, reference, tiled, cpu, cuda"),
        ],
    )  # fmt: skip
    def test_exception(self, change: dict[str, object], error: type[Exception], words: str) -> None:
        good = {
            "means": torch.zeros(2, 2), "cholesky": torch.tensor([[1.0, 0.0, 1.0]] * 2), "colors": torch.zeros(2, 3),
            "region_ids": torch.tensor([0, 1]), "regions": torch.tensor([[0, 1]]),
        }  # fmt: skip
        for backend in ("auto", "cpu", "tiled", "reference"):
            assert region_splat(**{**good, "backend": backend}).shape == (3, 1, 2)
            with pytest.raises(error, match=words):
                region_splat(**{**good, "backend": backend, **change})

    @pytest.mark.parametrize("steps", range(-12, -5))
    def test_all_backends_have_the_same_least_scale(self, steps: int) -> None:
        """Around the limit, one float32 number after the other, a Gaussian renders or is refused, and never else."""
        scale = torch.tensor(1e-6).view(torch.int32).add(steps).view(torch.float32)
        cholesky = torch.stack([scale, torch.zeros(()), scale])[None]
        verdicts = set()
        for backend in ("cpu", "tiled", "reference"):
            try:
                region_splat(torch.ones(1, 2), cholesky, torch.ones(1, 3), size=(2, 2), backend=backend)
                verdicts.add("renders")
            except ValueError:
                verdicts.add("refused")
        assert verdicts == {"renders" if float(scale) >= LEAST_SCALE else "refused"}

    def test_feature(self, backend: str, device: torch.device, dtype: torch.dtype) -> None:
        """Three Gaussians, two regions, written out."""
        means = [(1.0, 1.0), (3.5, 0.5), (2.0, 1.5)]
        factors = [(1.0, 0.0, 1.0), (2.0, 1.0, 0.5), (0.75, -0.375, 1.5)]
        colors = [(1.0, 0.0), (0.25, -0.5), (0.0, 2.0)]
        ids = [5, 9, 5]
        labels = [[5, 5, 9, 9], [5, 9, 9, 5]]
        expected = torch.zeros(2, 2, 4, dtype=torch.float64)
        for i, j, k in itertools.product(range(2), range(4), range(3)):
            (mx, my), (l11, l21, l22) = means[k], factors[k]
            s_xx, s_xy, s_yy = l11 * l11, l11 * l21, l21 * l21 + l22 * l22
            dx, dy = j + 0.5 - mx, i + 0.5 - my
            q = (s_yy * dx * dx - 2 * s_xy * dx * dy + s_xx * dy * dy) / (s_xx * s_yy - s_xy * s_xy)
            for c in range(2):
                expected[c, i, j] += (ids[k] == labels[i][j]) * math.exp(-0.5 * q) * colors[k][c]
        for kind in (dtype, torch.float32 if backend in ("cpu", "cuda") else torch.float64):
            scene = [torch.tensor(v, dtype=kind, device=device) for v in (means, factors, colors)]
            scene += [torch.tensor(v, device=device) for v in (ids, labels)]
            image = region_splat(*scene, cutoff=0, backend=backend)
            self.assert_close(image, expected.to(dtype=kind, device=device))
            assert image.abs().max() > 0.5

    def test_feature_soft_membership(self, backend: str) -> None:
        labels = torch.tensor([[0, 0, 0, 1, 1, 1]])
        flat = torch.tensor([[1e6, 0.0, 1e6]])
        regions = RegionMap(labels, softness=0.5)
        image = region_splat(
            torch.zeros(1, 2), flat, torch.ones(1, 1), torch.tensor([0]), regions, cutoff=0, backend=backend
        )
        kernel = [math.exp(-0.5 * (d / 0.5) ** 2) for d in range(3)]  # the blur is cut at 4 sigma = 2 px
        share = [
            sum(kernel[abs(i - j)] for j in range(3) if abs(i - j) <= 2)
            / sum(kernel[abs(i - j)] for j in range(6) if abs(i - j) <= 2)
            for i in range(6)
        ]
        torch.testing.assert_close(image[0, 0], torch.tensor(share), rtol=0, atol=1e-6)
        assert share[0] == 1.0 and share[5] == 0.0 and 0.5 < share[2] < 1.0

    @pytest.mark.parametrize(
        ("backend", "regions", "softness"),
        [("reference", 1, 0.0), ("reference", 3, 0.0), ("reference", 3, 0.8), ("tiled", 3, 0.8)],
    )
    def test_gradcheck(self, backend: str, regions: int, softness: float) -> None:
        scene = random_scene(3, (9, 19), regions, channels=2)
        region_map = RegionMap(scene.labels, softness)

        def render(means: Tensor, cholesky: Tensor, colors: Tensor) -> Tensor:
            return region_splat(means, cholesky, colors, scene.region_ids, region_map, cutoff=0, backend=backend)

        self.gradcheck(render, scene[:3], fast_mode=backend != "tiled")

    def test_gradients_of_one_argument(self, backend: str) -> None:
        scene = as_float32(random_scene(20, (20, 30), 2))
        full = gradients(scene, RegionMap(scene.labels), backend=backend)[1]
        for position in range(3):
            inputs = [t.detach().requires_grad_(i == position) for i, t in enumerate(scene[:3])]
            image = region_splat(*inputs, *scene[3:], backend=backend)
            probe = torch.linspace(-1, 2, image.numel(), dtype=image.dtype).view_as(image)
            (image * probe).sum().backward()
            torch.testing.assert_close(inputs[position].grad, full[position], rtol=1e-5, atol=1e-5)
            assert all(t.grad is None for i, t in enumerate(inputs) if i != position)

    def test_module(self, backend: str, device: torch.device, dtype: torch.dtype) -> None:
        """RegionSplatRenderer is the twin; a field holds no half precision, and renders in float32."""
        scene = on(device, dtype, random_scene(40, (20, 30), 3))
        field = GaussianField(*scene[:4], size=(20, 30))
        image = RegionSplatRenderer(cutoff=1e-3, backend=backend)(field, scene.labels)
        expected = region_splat(*(t.to(image.dtype) for t in scene[:3]), *scene[3:], cutoff=1e-3, backend=backend)
        assert expected.any() and torch.equal(image, expected)

    def test_dynamo(self, device: torch.device, dtype: torch.dtype) -> None:
        scene = on(device, dtype, random_scene(12, (9, 17), 3))
        regions = RegionMap(scene.labels, 0.8)
        leaves = [t.requires_grad_() for t in scene[:3]]

        def render(*tensors: Tensor) -> Tensor:
            return region_splat(*tensors, scene.region_ids, regions)

        self.assert_compiles(render, *leaves, leaves=leaves, backend="aot_eager")


class TestAgainstReference:
    @pytest.mark.parametrize(
        ("size", "regions", "softness"),
        [((1, 1), 1, 0.0), ((1, 700), 5, 0.7), ((33, 16), 5, 0.0), ((47, 61), 1, 0.0), ((47, 61), 5, 3.0)],
    )
    def test_cutoff_zero(self, backend: str, size: tuple[int, int], regions: int, softness: float) -> None:
        scene = random_scene(60, size, regions)
        region_map = RegionMap(scene.labels, softness)
        expected, expected_gradients = gradients(scene, region_map, cutoff=0, backend="reference")
        result, result_gradients = gradients(as_float32(scene), region_map, cutoff=0, backend=backend)
        assert result.dtype == torch.float32
        assert (result - expected).abs().max() < 1e-5
        assert expected.abs().max() > 1e-3
        assert_gradients_close(result_gradients, expected_gradients, 1e-4)

    def test_cutoff_error_is_bounded(self, backend: str) -> None:
        scene = random_scene(300, (64, 80), 3)
        exact = region_splat(*scene, cutoff=0, backend="reference")
        result = region_splat(*as_float32(scene), cutoff=1e-2, backend=backend)
        # every skipped weight is below the cutoff: the error is at most cutoff x the colours that overlap
        overlap = scene.colors.abs().sum()
        assert (result - exact).abs().max() <= 2e-2 * overlap
        assert (result - exact).abs().max() > 0

    @pytest.mark.parametrize(
        ("size", "mean", "cholesky"),
        [((40, 63), (57.566, 14.5225), (14.115, -15.117, 15.723)), ((128, 128), (65.2, 63.7), (21.2, 0.0, 21.2))],
    )
    def test_coarse_grids_reach_their_bound(
        self, backend: str, size: tuple[int, int], mean: tuple[float, float], cholesky: tuple[float, float, float]
    ) -> None:
        """Between nodes the error of a wide Gaussian is 3.2 times the cutoff at most, and of cpu more than its half."""
        scene = torch.tensor([mean]).double(), torch.tensor([cholesky]).double(), torch.ones(1, 1).double()
        exact = region_splat(*scene, size=size, cutoff=0, backend="reference")
        result = region_splat(*(t.float() for t in scene), size=size, backend=backend)
        error = (result - exact).abs().max()
        assert error <= 3.2e-4 and (backend != "cpu" or error > 1.6e-4)

    @pytest.mark.parametrize(("count", "size", "channels"), [(3000, (16, 16), 3), (40, (20, 30), 1), (40, (20, 30), 9)])
    def test_channels_and_long_lists(self, backend: str, count: int, size: tuple[int, int], channels: int) -> None:
        """3000 Gaussians of one tile are more than a segment of the kernels' lists."""
        scene = random_scene(count, size, 3, channels=channels)
        regions = RegionMap(scene.labels)
        expected, expected_gradients = gradients(scene, regions, cutoff=0, backend="reference")
        result, result_gradients = gradients(as_float32(scene), regions, cutoff=0, backend=backend)
        tolerance = 2e-4 if count > 40 else 2e-5
        torch.testing.assert_close(result.double(), expected, rtol=tolerance, atol=tolerance)
        assert_gradients_close(result_gradients, expected_gradients, tolerance)


class TestConstraint:
    def test_other_regions_do_not_change_a_bit(self, backend: str) -> None:
        scene = as_float32(random_scene(200, (60, 75), 4))
        before = region_splat(*scene, backend=backend)
        inside = scene.region_ids == 20
        assert inside.any()
        generator = torch.Generator().manual_seed(1)
        changed = [torch.where(inside[:, None], 3 * torch.rand(t.shape, generator=generator) + 1, t) for t in scene[:3]]
        after = region_splat(*changed, *scene[3:], backend=backend)
        outside = scene.labels != 20
        assert torch.equal(before[:, outside], after[:, outside])
        assert not torch.equal(before[:, ~outside], after[:, ~outside])

    def test_an_unknown_region_paints_nothing(self, backend: str) -> None:
        scene = as_float32(random_scene(10, (12, 12), 2))
        means, ids = scene.means.requires_grad_(), torch.full_like(scene.region_ids, 77)
        for labels in (scene.labels, torch.zeros(12, 12, dtype=torch.long)):
            image = region_splat(means, *scene[1:3], ids, labels, backend=backend)
            assert not image.any() and not torch.autograd.grad(image.sum(), means)[0].any()

    def test_one_region_equals_no_regions(self, backend: str) -> None:
        scene = as_float32(random_scene(30, (20, 33), 1))
        plain = region_splat(*scene[:3], size=(20, 33), backend=backend)
        assert torch.equal(region_splat(*scene, backend=backend), plain)


class TestConventions:
    def test_empty(self, backend: str) -> None:
        empty = torch.zeros(0, 2), torch.zeros(0, 3), torch.zeros(0, 3)
        image = region_splat(*(t.requires_grad_() for t in empty), size=(4, 5), backend=backend)
        assert torch.equal(image, torch.zeros(3, 4, 5))
        image.sum().backward()
        assert empty[0].grad is None or empty[0].grad.shape == (0, 2)

    @pytest.mark.parametrize("dtype", [torch.uint8, torch.uint32])
    def test_integer_dtypes_of_ids(self, backend: str, dtype: torch.dtype) -> None:
        scene = as_float32(random_scene(20, (20, 30), 2))
        image = region_splat(*scene[:3], scene.region_ids.to(dtype), scene.labels.to(dtype), backend=backend)
        assert torch.equal(image, region_splat(*scene, backend=backend))

    def test_strided_and_lazily_negated(self, backend: str) -> None:
        scene = as_float32(random_scene(20, (20, 30), 2))
        negative = region_splat(*scene[:2], torch._neg_view(scene.colors), *scene[3:], backend=backend)
        torch.testing.assert_close(negative, -region_splat(*scene, backend=backend))
        strided = [t.T.contiguous().T for t in scene[:3]]
        assert not strided[0].is_contiguous()
        labels = scene.labels.T.contiguous().T
        image = region_splat(*strided, scene.region_ids, labels, backend=backend)
        assert torch.equal(image, region_splat(*scene, backend=backend))

    def test_same_bits_every_time(self, backend: str) -> None:
        scene = as_float32(random_scene(500, (60, 75), 4))
        region_map = RegionMap(scene.labels, 0.7)
        first, second = (gradients(scene, region_map, backend=backend) for _ in range(2))
        assert torch.equal(first[0], second[0])
        assert all(torch.equal(a, b) for a, b in zip(first[1], second[1], strict=True))
