"""Coarse grids: the level of each Gaussian, agreement of backends, gradients."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from kcgs.kernels import Membership, SplatInputs, reference, tiled
from kcgs.kernels.coarse_grids import choose_levels, coarsen, grids_of, max_spacing, uncoarsen
from kcgs.kernels.cpu import kernel as cpu
from kcgs.kernels.pairs import list_pairs
from kcgs.kernels.splines import gather, sample

CUTOFF = 1e-4


def make_inputs(
    size: tuple[int, int] = (110, 150), *, n: int = 40, batch: int = 1, maps: int = 0, softness: float = 0.0
) -> SplatInputs:
    """Scatter Gaussians of half a pixel to twice the image, around and in it; some of no region of the map."""
    generator = torch.Generator().manual_seed(0)
    height, width = size
    means = (torch.rand(batch, n, 2, generator=generator) * 1.2 - 0.1) * torch.tensor([width, height])
    sigma = 0.5 * (4 * max(size)) ** torch.rand(batch, n, 1, generator=generator)
    cholesky = sigma * (torch.rand(batch, n, 3, generator=generator) + torch.tensor([0.5, -0.5, 0.5]))
    colors = torch.rand(batch, n, 3, generator=generator) - 0.3
    if maps == 0:
        return SplatInputs(means, cholesky, colors, None, None, size, CUTOFF)
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    labels = ((x - width / 2) ** 2 + (y - height / 3) ** 2 < (height / 3) ** 2).long() + 2 * (x + y > width).long()
    membership = Membership(torch.stack([labels.roll(5 * k, 1) for k in range(maps)]), 4, softness)
    ids = torch.randint(-1, 4, (batch, n), generator=generator)
    return SplatInputs(means, cholesky, colors, ids, membership, size, CUTOFF)


def double(inputs: SplatInputs) -> SplatInputs:
    return SplatInputs(*(t.double() for t in inputs[:3]), *inputs[3:])


def render(kernel: object, inputs: SplatInputs) -> list[Tensor]:
    """Return the image and the gradients of all three."""
    steps = kernel.steps(inputs)  # type: ignore[attr-defined]
    plan = steps.plan(inputs)
    image = steps.render(plan, inputs)
    probe = torch.linspace(-1, 2, image.numel(), dtype=torch.float64).view_as(image).to(image.dtype)
    return [image, *steps.differentiate(plan, inputs, probe, True)]


def assert_close(got: list[Tensor], want: list[Tensor], tolerance: float) -> None:
    for a, b in zip(got, want, strict=True):
        assert a.shape == b.shape and b.abs().max() > 1e-3
        assert (a.double() - b.double()).abs().max() <= tolerance * b.abs().max()


@pytest.mark.parametrize("size", [(110, 150), (33, 17), (5, 70), (9, 8)])
@pytest.mark.parametrize(
    ("batch", "maps", "softness"), [(1, 0, 0.0), (2, 0, 0.0), (1, 1, 0.0), (2, 1, 0.7), (2, 2, 0.7)]
)
def test_backends_agree(size: tuple[int, int], batch: int, maps: int, softness: float) -> None:
    inputs = make_inputs(size, batch=batch, maps=maps, softness=softness)
    assert (list_pairs(inputs).wide is None) == (max(size) <= 32)
    got, exact = render(tiled, inputs), render(tiled, double(inputs))
    assert_close(got, render(cpu, inputs), 4e-6)
    assert_close(got, exact, 4e-6)
    want = render(reference, double(inputs)._replace(cutoff=0.0))
    assert_close(exact[:1], want[:1], 5e-4)
    assert_close(exact[1:], want[1:], 3e-3)


def test_one_gaussian_of_each_level() -> None:
    inputs = make_inputs((150, 110), n=4, maps=1, softness=0.7)
    sigma = 2.0 ** torch.arange(4) / (max_spacing(CUTOFF) / 2**0.25) * 1.01
    cholesky = sigma[:, None] * torch.tensor([[[1.0, 0.0, 1.0]]])
    inputs = inputs._replace(cholesky=cholesky, region_index=torch.tensor([[0, 1, 2, 1]]))
    pairs = list_pairs(inputs)
    assert pairs.wide is not None and pairs.wide.gaussians.level.tolist() == [1, 2, 3]
    assert pairs.wide.ids.tolist() == [1, 2, 3]
    assert_close(render(tiled, inputs), render(cpu, inputs), 2e-6)


def test_narrow_gaussians_have_no_grids() -> None:
    inputs = make_inputs(maps=1)._replace(cholesky=torch.tensor([1.9, 0.0, 1.9]).expand(1, 40, 3))
    assert list_pairs(inputs).wide is None
    assert list_pairs(make_inputs(maps=1)._replace(cutoff=0.0)).wide is None
    assert inputs.membership is not None and "blocks" not in inputs.membership._derived


def test_no_gaussians() -> None:
    inputs = make_inputs(n=0, maps=1)
    image, *gradients = render(tiled, inputs)
    assert torch.equal(image, torch.zeros(1, 3, 110, 150))
    assert [g.shape for g in gradients] == [(1, 0, 2), (1, 0, 3), (1, 0, 3)]


def test_same_bits_every_time() -> None:
    inputs = make_inputs(batch=2, maps=1, softness=0.7)
    assert all(map(torch.equal, render(tiled, inputs), render(tiled, inputs)))


def test_gather_is_the_transpose_of_sample() -> None:
    inputs = make_inputs((150, 110), batch=2, maps=1, softness=0.7)
    pairs = list_pairs(inputs)
    assert pairs.wide is not None and inputs.membership is not None
    plan, masks = pairs.wide.nodes, inputs.membership.tiles(16).masks
    assert any(step.masks is not None for step in plan.samples)
    nodes, pixels = (
        torch.randn(k, 2, 16, 16, dtype=torch.float64) for k in (plan.num_live + 1, pairs.num_tiles - plan.num_live - 1)
    )
    nodes[-1] = 0.0
    back, tiles = gather(pixels, plan, masks), torch.zeros_like(pixels)
    want = (nodes[:-1] * back[:-1]).sum()
    sample(nodes, plan, masks, tiles)
    torch.testing.assert_close((tiles * pixels).sum(), want, rtol=1e-12, atol=0)


def test_splines_of_one_are_one() -> None:
    inputs = make_inputs((150, 110))._replace(cholesky=torch.tensor([1e3, 0.0, 1e3]).expand(1, 40, 3))
    pairs = list_pairs(inputs)
    assert pairs.wide is not None
    # nodes of the coarsest grid alone
    plan, levels = pairs.wide.nodes, len(grids_of(inputs.size, 1))
    assert pairs.wide.gaussians.level.unique().tolist() == [levels - 1]
    nodes = torch.zeros(plan.num_live + 1, 1, 16, 16, dtype=torch.float64)
    finer = torch.cat([step.blocks for step in plan.refinements])
    coarsest = torch.ones(plan.num_live, dtype=torch.bool).index_fill(0, finer, False)
    nodes[:-1][coarsest] = 1.0
    tiles = torch.zeros(pairs.num_tiles - plan.num_live - 1, 1, 16, 16, dtype=torch.float64)
    sample(nodes, plan, None, tiles)
    seen = tiles.view(10, 7, 16, 16).transpose(1, 2).reshape(160, 112)[:150, :110]
    torch.testing.assert_close(seen, torch.ones_like(seen), rtol=1e-14, atol=0)


def test_levels_by_the_axes_of_the_ellipse() -> None:
    generator = torch.Generator().manual_seed(0)
    cholesky = torch.exp2(8 * torch.rand(500, 3, generator=generator, dtype=torch.float64) - 1)
    l11, l21, l22 = cholesky.unbind(-1)
    factor = torch.stack([torch.stack([l11, 0 * l11], -1), torch.stack([l21, l22], -1)], -2)
    scales = torch.linalg.svdvals(factor)
    fits = [((2.0**n / scales) ** 4).sum(-1) <= max_spacing(CUTOFF) ** 4 for n in range(1, 6)]
    levels = choose_levels(cholesky, max_spacing(CUTOFF), 6)
    assert torch.equal(levels, torch.stack(fits).sum(0)) and levels.unique().tolist() == list(range(6))
    assert not choose_levels(cholesky, max_spacing(0.0), 6).any()


def test_gradients_of_coarsened_gaussians() -> None:
    generator = torch.Generator().manual_seed(0)
    given = [10 + 90 * torch.rand(20, n, generator=generator, dtype=torch.float64) for n in (2, 3)]
    leaves = [t.clone().requires_grad_() for t in given]
    coarse = coarsen(torch.arange(20) % 3 + 1, *leaves)
    grads = [torch.randn(t.shape, generator=generator, dtype=torch.float64) for t in coarse[1:]]
    want = torch.autograd.grad(coarse[1:], leaves, grads)
    got = uncoarsen(given[1], coarse, *grads)
    torch.testing.assert_close(got, want, rtol=1e-10, atol=1e-12)


def test_gradcheck() -> None:
    """All weights reach the cutoff and no Gaussian changes its level, so that what is rendered is smooth."""
    inputs = double(make_inputs((40, 36), n=3, maps=1, softness=0.7))
    scales = torch.tensor([[30.0], [45.0], [20.0]], dtype=torch.float64)
    cholesky = scales * torch.tensor([[[1.0, 0.2, 1.2]]], dtype=torch.float64)
    centred = torch.tensor([[[18.0, 20.0], [10.0, 25.0], [20.0, 12.0]]], dtype=torch.float64)
    inputs = inputs._replace(means=centred, cholesky=cholesky, region_index=torch.tensor([[0, 1, 2]]))
    _, *gradients = render(tiled, inputs)
    for k, gradient in enumerate(gradients):
        given = inputs[:3][k]
        direction = torch.randn(given.shape, generator=torch.Generator().manual_seed(k), dtype=torch.float64)
        sides = []
        for step in (-1e-4, 1e-4):
            arrays = (given + step * direction if n == k else t for n, t in enumerate(inputs[:3]))
            image = render(tiled, SplatInputs(*arrays, *inputs[3:]))[0]
            sides.append((image * torch.linspace(-1, 2, image.numel(), dtype=torch.float64).view_as(image)).sum())
        want = (sides[1] - sides[0]).item() / 2e-4
        assert math.isclose((gradient * direction).sum().item(), want, rel_tol=1e-6)
