"""Proposals: the gain, confinement, suppression, and that the error falls."""

from __future__ import annotations

import importlib.util
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from kcgs import RegionMap, fit
from kcgs.fitting import propose_gaussians
from kcgs.fitting.pursuit import _average, _evaluate, _scales, propose
from kcgs.functional import lookup_regions, region_splat
from kcgs.nn import GaussianField


@pytest.mark.parametrize("has_maps", [False, True])
def test_a_batch_is_as_each_image_alone(has_maps: bool) -> None:
    """Where an image finds fewer Gaussians than others, its last rows have the colour 0."""
    errors = torch.stack([noise(3, (32, 40), seed=0), torch.zeros(3, 32, 40), 0.1 * noise(3, (32, 40), 9, seed=1)])
    labels = torch.stack([(torch.arange(40) >= x).long().expand(32, 40) for x in (10, 20, 30)]) if has_maps else None
    labels = None if labels is None else labels + 4  # the padding is of a region that there is
    batch = propose_gaussians(errors, 60, labels)
    alone = [propose_gaussians(e, 60, None if labels is None else labels[k]) for k, e in enumerate(errors)]
    assert alone[1].num_gaussians < batch.num_gaussians == max(field.num_gaussians for field in alone)
    for k, field in enumerate(alone):
        for expected, actual in zip(tensors(field), tensors(batch), strict=True):
            assert torch.equal(actual[k, : len(expected)], expected)
        assert not batch.colors[k, field.num_gaussians :].any()
        assert labels is None or torch.isin(batch.region_ids[k], labels[k]).all()


def noise(channels: int, size: tuple[int, int], smooth: int = 3, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    values = torch.randn(1, channels, *size, generator=generator)
    return torch.nn.functional.avg_pool2d(values, smooth, 1, smooth // 2, count_include_pad=False)[0]


def halves(size: tuple[int, int]) -> RegionMap:
    y, x = torch.meshgrid(torch.arange(size[0]), torch.arange(size[1]), indexing="ij")
    return RegionMap(torch.where(x + y // 3 < size[1] // 2, 4, 9))


def tensors(field: GaussianField) -> list[Tensor]:
    ids = [] if field.region_ids is None else [field.region_ids]
    return [field.means.detach(), field.cholesky.detach(), field.colors.detach(), *ids]


def render(field: GaussianField, regions: RegionMap | None) -> Tensor:
    means, cholesky, colors, *ids = tensors(field)
    return region_splat(means, cholesky, colors, *ids, regions, size=field.size, cutoff=0, backend="reference")


def dense_gain(residual: Tensor, mask: Tensor, x: float, y: float, sigma: float) -> float:
    rows, cols = torch.meshgrid(*(torch.arange(n) + 0.5 for n in mask.shape), indexing="ij")
    weight = torch.exp(-0.5 * ((cols - x) ** 2 + (rows - y) ** 2) / sigma**2) * mask
    return float(((weight * residual).sum((1, 2)) ** 2).sum() / (weight**2).sum())


def dense_filter(planes: Tensor, labels: Tensor, sigma: float) -> tuple[Tensor, Tensor]:
    """Return the gain and the colours of Gaussians at pixels, by a matrix for each column and each row."""
    for dim in (1, 2):
        lines, places = labels.movedim(dim - 1, 1), torch.arange(planes.shape[dim])
        distance = (places[:, None] - places).abs()
        weight = (lines[:, :, None] == lines[:, None]) & (distance <= np.ceil(3 * sigma))
        weights = [weight * torch.exp(-power * (distance.double() / sigma) ** 2) for power in (0.5, 0.5, 0.5, 1.0)]
        planes = (torch.stack(weights) @ planes.movedim(dim, 2)[..., None])[..., 0].movedim(2, dim)
    colors = planes[:3] / planes[3]
    return (planes[:3] * colors).sum(0), colors


class TestGain:
    @pytest.mark.parametrize(("channels", "regions"), [(1, None), (8, halves((40, 52)))])
    def test_the_definition(self, channels: int, regions: RegionMap | None) -> None:
        """Gains are those of each Gaussian in its region, exact but for blocks, and what a column and a row miss."""
        # error that varies no faster than the Gaussians, as that which they are chosen for
        residual = noise(channels, (40, 52), smooth=9).double()
        index = None if regions is None else regions.index.double()
        labels = None if index is None else index[0]
        scales = list(_scales(residual[None], index))
        assert [scale.sigma for scale in scales] == [0.7, 1.1, 1.8, 2.9, 4.7, 7.5]
        for sigma, block, gain, _ in scales:
            row, column = divmod(int(gain.argmax()), gain.shape[2])
            x, y = (column + 0.5) * block, (row + 0.5) * block
            mask = torch.ones(40, 52) if labels is None else labels == labels[int(y), int(x)]
            expected = dense_gain(residual, mask, x, y, sigma)
            assert float(gain.max()) == pytest.approx(expected, rel=0.02 if block == 1 else 0.15)

    @pytest.mark.parametrize("size", [(13, 57), (1, 3)])
    @pytest.mark.parametrize("has_labels", [False, True])
    def test_filters_see_one_label_along_columns_and_rows(self, size: tuple[int, int], has_labels: bool) -> None:
        generator = torch.Generator().manual_seed(0)
        planes = torch.rand(2, 4, *size, generator=generator)
        labels = torch.randint(0, 2, (2, *size), generator=generator).float()
        actual = _evaluate(planes, labels if has_labels else None, 1.3)
        for k in range(2):
            expected = dense_filter(planes[k].double(), labels[k] if has_labels else torch.zeros(size), 1.3)
            torch.testing.assert_close([values[k] for values in actual], [values.float() for values in expected])

    @pytest.mark.parametrize("block", [2, 8])
    def test_blocks_are_averaged_over_the_label_of_their_middle(self, block: int) -> None:
        generator, size = torch.Generator().manual_seed(0), (21, 30)
        planes = torch.rand(2, 3, *size, generator=generator)
        labels = torch.randint(0, 2, (2, *size), generator=generator)
        averages = _average(planes, labels.float(), block)
        assert averages.shape == (2, 3, size[0] // block, size[1] // block)
        for image, row, column in np.ndindex(2, *averages.shape[2:]):
            rows, columns = (slice(block * k, block * k + block) for k in (row, column))
            marks, values = labels[image, rows, columns], planes[image, :, rows, columns]
            is_same = marks == marks[block // 2, block // 2]
            torch.testing.assert_close(averages[image, :, row, column], (values * is_same).mean((1, 2)))


class TestProposal:
    @pytest.mark.parametrize(("channels", "dtype"), [(1, torch.float32), (8, torch.float64)])
    def test_shapes_and_order(self, channels: int, dtype: torch.dtype) -> None:
        residual = noise(channels, (40, 52)).to(dtype)
        proposal = propose(residual, halves((40, 52)), 15)
        assert [tuple(t.shape) for t in tensors(proposal)] == [(15, 2), (15, 3), (15, channels), (15,)]
        assert {t.dtype for t in tensors(proposal)[:3]} == {dtype}
        assert proposal.region_ids is not None and proposal.region_ids.dtype == torch.int64
        assert propose(residual, None, 3).region_ids is None

    @pytest.mark.parametrize(("count", "softness"), [(1, 0.8), (60, 0.0)])
    def test_error_falls(self, count: int, softness: float) -> None:
        residual = noise(3, (60, 72))
        regions = RegionMap(halves((60, 72)).labels, softness)
        left = residual - render(propose(residual, regions, count), regions)
        assert left.square().sum() < residual.square().sum() * (1 - 0.004 * count)

    def test_chosen_at_once_lie_apart(self) -> None:
        residual = noise(1, (96, 96), smooth=5)
        means, cholesky, _ = tensors(propose(residual, None, 12))
        for a, b in combinations(range(12), 2):
            square = float(cholesky[a, 0] ** 2 + cholesky[b, 0] ** 2)
            distance = float((means[a] - means[b]).square().sum())
            overlap = 2 * float(cholesky[a, 0] * cholesky[b, 0]) / square * np.exp(-0.5 * distance / square)
            assert overlap < 0.3

    def test_no_graph_and_no_gradient_needed(self) -> None:
        residual = noise(1, (20, 20)).requires_grad_()
        with torch.no_grad():
            proposal = propose(residual, None, 4)
        assert all(p.is_leaf for p in proposal.parameters())


class TestRegions:
    @pytest.mark.parametrize("size", [(33, 17), (1, 9)])
    def test_ids_are_those_under_the_centres(self, size: tuple[int, int]) -> None:
        labels = torch.randint(0, 4, size, generator=torch.Generator().manual_seed(1)) * 3
        regions = RegionMap(labels)
        means, _, _, ids = tensors(propose(noise(3, size, smooth=1), regions, 30))
        assert len(means) > 0
        assert (means > 0).all() and (means < means.new_tensor([size[1], size[0]])).all()
        assert torch.equal(lookup_regions(means, labels), ids)

    def test_one_pixel_region(self) -> None:
        labels = torch.zeros(20, 20, dtype=torch.long)
        labels[7, 11] = 5
        residual = torch.zeros(2, 20, 20)
        residual[:, 7, 11] = torch.tensor([0.5, -0.25])
        means, _, colors, ids = tensors(propose(residual, RegionMap(labels), 3))
        assert means.tolist() == [[11.5, 7.5]] and ids.tolist() == [5]
        torch.testing.assert_close(colors, torch.tensor([[0.5, -0.25]]))

    def test_checkerboard(self) -> None:
        labels = (torch.arange(24)[:, None] + torch.arange(30)) % 2
        regions = RegionMap(labels)
        # a flat error in the white squares alone, which touch at corners only
        residual = (0.5 * labels)[None].float()
        proposal = propose(residual, regions, 180)
        assert proposal.region_ids is not None and set(proposal.region_ids.tolist()) == {1}
        left = residual - render(proposal, regions)
        assert left.square().sum() < 0.5 * residual.square().sum()


class TestLimits:
    def test_nothing_is_proposed_for_no_error_or_no_count(self) -> None:
        assert len(propose(torch.zeros(3, 20, 30), halves((20, 30)), 10).means) == 0
        assert len(propose(noise(1, (8, 8)), None, 0).means) == 0

    @pytest.mark.parametrize(("size", "channels"), [((1, 1), 1), ((5, 7), 9)])
    def test_small_images(self, size: tuple[int, int], channels: int) -> None:
        """As many Gaussians as pixels, in several rounds, leave less than half of the error, even of noise."""
        residual = noise(channels, size, smooth=1)
        labels = torch.randint(0, 3, size, generator=torch.Generator().manual_seed(1))
        for regions in (None, RegionMap(labels)):
            proposal = propose(residual, regions, size[0] * size[1])
            left = residual - render(proposal, regions)
            assert left.square().sum() < 0.5 * residual.square().sum()

    def test_flat_error_is_filled_evenly(self) -> None:
        residual = torch.full((1, 128, 160), 0.3)
        proposal = propose(residual, None, 200)
        left = residual - render(proposal, None)
        assert left.square().sum() < 0.15 * residual.square().sum()
        # few of them, too, lie everywhere
        quarters = proposal.means.detach()[:40] // torch.tensor([80.0, 64.0])
        assert min((quarters == torch.tensor([x, y])).all(1).sum() for x in (0, 1) for y in (0, 1)) >= 5


def test_a_small_region_does_not_stay_black() -> None:
    image = torch.full((3, 40, 52), 0.2)
    labels = torch.zeros(40, 52, dtype=torch.long)
    for k, (row, column) in enumerate([(7, 11), (20, 30), (33, 48)], 1):
        labels[row, column : column + k] = k
        image[:, row, column : column + k] = 0.3 * k
    scene = fit(image, labels, 30, iterations=60).scene
    assert (scene.render() - image).abs()[:, labels > 0].max() < 0.1


@pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="Triton is not installed: pip install triton")
class TestTriton:
    @pytest.mark.parametrize(("capability", "has_labels"), [(80, False), (90, True)])
    def test_compiles_without_a_gpu(
        self, capability: int, has_labels: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        import triton
        from triton.backends.compiler import GPUTarget

        from kcgs.fitting import pursuit_cuda as cuda

        monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
        constants = {"MAPPED": has_labels, "PIXELS": cuda._PIXELS}
        integers = ("area", "stride", "length", "labels_per_image", "reach")
        types = {**dict.fromkeys(constants, "constexpr"), **dict.fromkeys(integers, "i32")}
        types["exponent"] = "fp32"
        signature = {name: types.get(name, "*fp32") for name in cuda._blur.jit.arg_names}
        source = triton.compiler.ASTSource(cuda._blur.jit, signature, constants)
        triton.compile(source, target=GPUTarget("cuda", capability, 32), options=cuda._blur.options)
