"""Coarse grids: the level of each Gaussian, and the CPU kernel against their formulas."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from kcgs.kernels import SplatInputs, reference
from kcgs.kernels.coarse_grids import choose_levels, coarsen, grids_of, max_spacing
from kcgs.kernels.cpu import kernel as cpu
from kcgs.maps import MapTable, membership_at, with_positions
from kcgs.maps.widths import blurs_of

CUTOFF = 1e-4


def make_inputs(size: tuple[int, int], batch: int, maps: int, softness: float) -> SplatInputs:
    """Scatter Gaussians of half a pixel to twice the image, around and in it; some of no region of the map."""
    generator = torch.Generator().manual_seed(0)
    (height, width), n = size, 40
    means = (torch.rand(batch, n, 2, generator=generator) * 1.2 - 0.1) * torch.tensor([width, height])
    sigma = 0.5 * (4 * max(size)) ** torch.rand(batch, n, 1, generator=generator)
    cholesky = sigma * (torch.rand(batch, n, 3, generator=generator) + torch.tensor([0.5, -0.5, 0.5]))
    colors = torch.rand(batch, n, 3, generator=generator) - 0.3
    if maps == 0:
        return SplatInputs(means, cholesky, colors, None, None, size, CUTOFF)
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    labels = ((x - width / 2) ** 2 + (y - height / 3) ** 2 < (height / 3) ** 2).long() + 2 * (x + y > width).long()
    labels = torch.stack([labels.roll(5 * k, 1) for k in range(maps)])
    table = with_positions(MapTable(labels, blurs_of((softness,), labels.device)))
    ids = torch.randint(-1, 4, (batch, n), generator=generator)
    return SplatInputs(means, cholesky, colors, ids, table, size, CUTOFF)


def double(inputs: SplatInputs) -> SplatInputs:
    return SplatInputs(*(t.double() for t in inputs[:3]), *inputs[3:])


def render(kernel: object, inputs: SplatInputs) -> list[Tensor]:
    """Return the image and the gradients of all three."""
    steps = kernel.kernel_for(inputs)  # type: ignore[attr-defined]
    plan = steps.plan(inputs)
    image = steps.render(plan, inputs)
    return [image, *steps.differentiate(plan, inputs, probe(image), True)]


def probe(image: Tensor) -> Tensor:
    return torch.linspace(-1, 2, image.numel(), dtype=torch.float64).view_as(image).to(image.dtype)


def render_formulas(inputs: SplatInputs) -> list[Tensor]:
    """Return the same as the formulas of docs/performance.md have it: dense, in float64, differentiated by autograd."""
    leaves = [t.double().requires_grad_() for t in inputs[:3]]
    images = []
    for b in range(len(leaves[0])):
        gaussians = [t[b] for t in leaves]
        if inputs.table is None or inputs.region_positions is None:
            images.append(_render_region(*gaussians, inputs))
            continue
        total = torch.zeros(3, *inputs.size, dtype=torch.float64)
        membership = membership_at(inputs.table, inputs.size)
        for region in range(inputs.table.num_regions):
            members = inputs.region_positions[b] == region
            weights = membership.weights(b % inputs.table.shape[0], region, torch.float64)
            total = total + weights * _render_region(*(t[members] for t in gaussians), inputs)
        images.append(total)
    image = torch.stack(images)
    return [image.detach(), *torch.autograd.grad(image, leaves, probe(image))]


def _render_region(means: Tensor, cholesky: Tensor, colors: Tensor, inputs: SplatInputs) -> Tensor:
    grids = grids_of(inputs.size, 1)
    level = choose_levels(cholesky.detach(), max_spacing(inputs.cutoff), len(grids))

    def evaluate(*gaussians: Tensor, n: int) -> Tensor:
        size = grids[n].height, grids[n].width
        return reference.splat(SplatInputs(*(t[None] for t in gaussians), None, None, size, inputs.cutoff))[0]

    image = evaluate(means[level == 0], cholesky[level == 0], colors[level == 0], n=0)
    nodes = torch.zeros(len(image), grids[-1].height, grids[-1].width, dtype=torch.float64)
    for n in reversed(range(1, len(grids))):
        wide = level == n
        coarse = coarsen(level[wide], means[wide], cholesky[wide])
        nodes = nodes + evaluate(coarse.means, coarse.cholesky, coarse.factor[:, None] * colors[wide], n=n)
        weights = _sampling if n == 1 else _refinement
        rows, columns = (weights(*sides) for sides in zip(grids[n - 1][:2], grids[n][:2], strict=True))
        nodes = rows @ nodes @ columns.T
    return image + nodes if len(grids) > 1 else image


def _refinement(fine: int, coarse: int) -> Tensor:
    """Return (1, 4, 6, 4, 1) / 8 about each node of an axis."""
    weights = {d: math.comb(4, d + 2) / 8 for d in range(-2, 3)}
    rows = [[weights.get(j - 2 * k + 1, 0.0) for k in range(coarse)] for j in range(fine)]
    return torch.tensor(rows, dtype=torch.float64)


def _sampling(pixels: int, nodes: int) -> Tensor:
    """Return the cubic B-splines of nodes, the first at -2 pixels, at the centres of pixels."""
    return torch.tensor([[_spline(abs((j + 0.5) / 2 - (k - 1))) for k in range(nodes)] for j in range(pixels)]).double()


def _spline(distance: float) -> float:
    if distance < 1:
        return 2 / 3 - distance**2 + distance**3 / 2
    return max(2 - distance, 0.0) ** 3 / 6


def assert_close(got: list[Tensor], want: list[Tensor], tolerance: float) -> None:
    for a, b in zip(got, want, strict=True):
        assert a.shape == b.shape and b.abs().max() > 1e-3
        assert (a.double() - b.double()).abs().max() <= tolerance * b.abs().max()


@pytest.mark.parametrize(
    ("size", "batch", "maps", "softness"),
    [
        ((110, 150), 2, 2, 0.7),
        ((33, 17), 1, 1, 0.0),
        ((5, 70), 2, 0, 0.0),
        ((9, 8), 2, 1, 0.7),
    ],
)
def test_cpu_agrees(size: tuple[int, int], batch: int, maps: int, softness: float) -> None:
    inputs = make_inputs(size, batch, maps, softness)
    plan = cpu.plan(inputs)
    assert plan is not None and bool(plan.lists.live.any()) == (max(size) > 32)
    got = render(cpu, inputs)
    assert_close(got, render_formulas(inputs), 4e-6)
    want = render(reference, double(inputs)._replace(cutoff=0.0))
    assert_close(got[:1], want[:1], 5e-4)
    assert_close(got[1:], want[1:], 3e-3)
