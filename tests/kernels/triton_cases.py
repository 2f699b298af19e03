"""Cases that test_cuda.py runs in a process of their own: on a GPU, or with TRITON_INTERPRET=1 in numpy."""

from __future__ import annotations

import math
from types import ModuleType

import pytest
import torch
from torch import Tensor

from kcgs.functional.operator import splat_operator
from kcgs.kernels import Membership, SplatInputs, cuda, reference, tiled

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
GPU = DEVICE.type == "cuda"
# The interpreter takes most of a second for a piece of a tile's list, however few pixels and Gaussians it has: cases
# are as small as what they are about lets them be, and larger where a GPU renders them.
if cuda._interpreted():
    # it would patch the whole language anew at every call of a function; plain Python is a part of what calls it
    cuda._weigh = cuda._weigh.fn


def make_inputs(
    n: int = 20,
    size: tuple[int, int] = (16, 20),
    *,
    regions: int = 1,
    softness: float = 0.0,
    channels: int = 3,
    batch: int = 1,
    maps: int = 1,
    cutoff: float = 0.0,
) -> SplatInputs:
    generator = torch.Generator().manual_seed(0)
    height, width = size

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    means = uniform(batch, n, 2) * torch.tensor([width, height]) * 1.2 - 0.1 * torch.tensor([width, height])
    sigma = 0.6 * math.sqrt(height * width / max(n, 1)) + 0.3
    cholesky = sigma * (uniform(batch, n, 3) + torch.tensor([0.3, -0.5, 0.3]))
    index, membership = None, None
    if regions > 1:
        y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        labels = ((x > width // 2) + 2 * (y > height // 2)) % regions
        labels = torch.stack([labels.roll(3 * i, 1) for i in range(maps)]).to(DEVICE)
        membership = Membership(labels, regions, softness)
        index = torch.randint(-1, regions, (batch, n), generator=generator).to(DEVICE)
    arrays = (t.to(DEVICE) for t in (means, cholesky, uniform(batch, n, channels) - 0.3))
    return SplatInputs(*arrays, index, membership, size, cutoff)


def render(kernel: ModuleType, inputs: SplatInputs) -> list[Tensor]:
    """Return the image and the gradients."""
    steps = kernel.steps(inputs)
    plan = steps.plan(inputs)
    image = steps.render(plan, inputs)
    probe = torch.linspace(-1, 2, image.numel(), dtype=image.dtype, device=DEVICE).view_as(image)
    return [image, *steps.differentiate(plan, inputs, probe, True)]


def assert_matches_reference(inputs: SplatInputs, tolerance: float = 5e-6) -> None:
    got = render(cuda, inputs)
    want = render(reference, SplatInputs(*(t.double() for t in inputs[:3]), *inputs[3:]))
    for a, b in zip(got, want, strict=True):
        assert a.dtype == torch.float32 and a.shape == b.shape
        assert b.abs().max() > 1e-3
        assert (a.double() - b).abs().max() <= tolerance * b.abs().max()
        cosine = torch.nn.functional.cosine_similarity(a.double().flatten(), b.flatten(), dim=0)
        assert cosine >= 1 - tolerance


@pytest.mark.parametrize(
    ("size", "softness"), [((1, 1), 0.0), ((17, 18), 0.7), *([((17, 33), 0.0), ((17, 33), 0.7)] if GPU else [])]
)
def test_sizes(size: tuple[int, int], softness: float) -> None:
    assert_matches_reference(make_inputs(size=size, regions=1 if size == (1, 1) else 3, softness=softness))


@pytest.mark.parametrize(("regions", "cutoff"), [(1, 1e-3), (2, 0.0), *([(1, 0.0), (2, 1e-3)] if GPU else [])])
def test_cutoffs(regions: int, cutoff: float) -> None:
    assert_matches_reference(make_inputs(40, (16, 20) if GPU else (9, 16), regions=regions, cutoff=cutoff))


# one; more than a block, and part of the last; part of a block; blocks
@pytest.mark.parametrize("channels", [1, 11, *([5, 32] if GPU else [])])
def test_channels(channels: int) -> None:
    assert_matches_reference(make_inputs(size=(16, 16), channels=channels))


@pytest.mark.parametrize(("maps", "size"), [(2, (16, 20)), *([(1, (9, 16)), (1, (16, 20))] if GPU else [])])
def test_batch(maps: int, size: tuple[int, int]) -> None:
    assert_matches_reference(make_inputs(size=size, batch=2, maps=maps, regions=3, softness=0.7))


def test_tile_inside_one_region_beside_mixed_tiles() -> None:
    inputs = make_inputs(size=(16, 48), regions=2)
    assert inputs.membership is not None
    assert len(inputs.membership.tiles(16).keys) > (inputs.membership.tiles(16).mask_rows < 0).sum() > 0
    assert_matches_reference(inputs)


@pytest.mark.parametrize(("regions", "batch"), [(2, 1), *([(1, 1), (3, 2)] if GPU else [])])
def test_wide_gaussians_on_coarse_grids(regions: int, batch: int) -> None:
    size = (70, 90) if GPU else (9, 33)
    inputs = make_inputs(5, size, regions=regions, softness=0.7, channels=2, batch=batch, cutoff=1e-4)
    inputs = inputs._replace(cholesky=inputs.cholesky * 3.0 ** torch.arange(5.0, device=DEVICE)[:, None] / 9)
    wide = cuda.list_pairs(inputs).wide
    assert wide is not None and 0 < len(wide.ids) < inputs.colors[..., 0].numel()
    double = SplatInputs(*(t.double() for t in inputs[:3]), *inputs[3:])
    for a, b in zip(render(cuda, inputs), render(tiled, double), strict=True):
        assert (a - b).abs().max() <= 5e-6 * b.abs().max()


def test_list_longer_than_a_piece() -> None:
    count = 300 if GPU else 70
    inputs = make_inputs(count, size=(9, 16), regions=2, softness=0.5)
    assert count > 2 * cuda._PIECE
    assert_matches_reference(inputs, 2e-5)


def test_slanted_needles() -> None:
    angles = torch.linspace(0.1, math.pi, 20, dtype=torch.float64)
    cos, sin = angles.cos(), angles.sin()
    l11 = torch.hypot(1e4 * cos, sin)
    cholesky = torch.stack([l11, (1e8 - 1) * sin * cos / l11, 1e4 / l11], -1).float()[None].to(DEVICE)
    inputs = make_inputs(size=(16, 20) if GPU else (16, 16))._replace(cholesky=cholesky)
    want = reference.splat(SplatInputs(*(t.double() for t in inputs[:3]), *inputs[3:])).detach()
    got = render(cuda, inputs)
    assert (got[0] - want).abs().max() < 1e-5 * 20
    assert all(torch.isfinite(t).all() for t in got)


def test_gradient_layouts_and_colours_alone() -> None:
    inputs = make_inputs(size=(16, 20) if GPU else (9, 16))
    steps = cuda.steps(inputs)
    plan = steps.plan(inputs)
    ones = torch.ones(1, 3, *inputs.size, device=DEVICE)
    gradients = steps.differentiate(plan, inputs, ones, True)
    for layout in (ones[0, 0, 0, 0].expand(ones.shape), ones.permute(0, 2, 3, 1).contiguous().permute(0, 3, 1, 2)):
        assert torch.equal(steps.differentiate(plan, inputs, layout, True)[0], gradients[0])
    assert gradients[0].any()
    assert torch.equal(steps.differentiate(plan, inputs, ones, False)[2], gradients[2])


@pytest.mark.parametrize("count", [0, 3])
@pytest.mark.parametrize("regions", [1, 2])
def test_nothing_to_render(count: int, regions: int) -> None:
    inputs = make_inputs(count, regions=regions)
    inputs = inputs._replace(means=torch.full_like(inputs.means, 1e6))
    image, *gradients = render(cuda, inputs)
    assert torch.equal(image, torch.zeros(1, 3, 16, 20, device=DEVICE))
    for gradient, array in zip(gradients, inputs[:3], strict=True):
        assert torch.equal(gradient, torch.zeros_like(array))


def test_same_bits_every_time() -> None:
    inputs = make_inputs(400 if GPU else 20, size=(9, 16), regions=3, softness=0.7)
    first, second = render(cuda, inputs), render(cuda, inputs)
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_operator() -> None:
    """The operator and its gradient mutate and alias nothing; tracing is the same for every backend."""
    inputs = make_inputs(4, size=(8, 16))
    labels = (torch.arange(16, device=DEVICE) // 9).expand(8, 16).contiguous()
    ids = torch.tensor([[0, 1, 0, 1]], device=DEVICE)
    settings = ids, labels, None, 8, 16, 0.0
    backward = torch.ops.kcgs.region_splat_backward.default
    grad = torch.rand(1, 3, 8, 16, device=DEVICE)
    torch.library.opcheck(splat_operator, (*inputs[:3], *settings, "cuda"), test_utils="test_schema")
    torch.library.opcheck(backward, (grad, *inputs[:3], *settings, "cuda", True), test_utils="test_schema")
    gradients, expected = (backward(grad, *inputs[:3], *settings, name, True) for name in ("cuda", "reference"))
    for a, b in zip(gradients, expected, strict=True):
        assert b.any() and (a - b).abs().max() <= 1e-5 * b.abs().max()
