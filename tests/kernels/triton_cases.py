"""Cases that tests/test_triton.py runs in a process of their own: on a GPU, or with TRITON_INTERPRET=1 in numpy."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import ModuleType
from typing import Any

import pytest
import torch
import triton
from torch import Tensor

from kcgs import GaussianField, RegionMap, RegionSplatRenderer
from kcgs.functional import region_splat
from kcgs.kernels import SplatInputs, cuda, reference, settle, without_waiting
from kcgs.kernels.cuda import capacity, gather, plan, render, triton_function
from kcgs.maps import MapTable, with_positions
from kcgs.maps.widths import blurs_of, find_widths
from kcgs.optim import GaussianAdam

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
GPU = DEVICE.type == "cuda"
needs_gpu = pytest.mark.skipif(not GPU, reason="needs a GPU")
if triton_function.is_interpreted():
    # it would patch the whole language anew at every call of a function; plain Python is a part of what calls it
    for module in (plan, render, gather):
        module.core = triton.language.core  # a launch patches it, too
    for module in (triton.language, plan, render, gather):
        for name, function in [*vars(module).items()]:
            if isinstance(function, triton.KernelInterface):
                setattr(module, name, function.fn)


def make_inputs(
    n: int = 20,
    size: tuple[int, int] = (16, 20),
    *,
    regions: int = 1,
    softness: float | dict[tuple[int, int], float] = 0.0,
    channels: int = 3,
    batch: int = 1,
    maps: int = 1,
    cutoff: float = 0.0,
) -> SplatInputs:
    """Make inputs with positions of regions, as `reference` takes them."""
    generator = torch.Generator().manual_seed(0)
    height, width = size

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    means = uniform(batch, n, 2) * torch.tensor([width, height]) * 1.2 - 0.1 * torch.tensor([width, height])
    sigma = 0.6 * math.sqrt(height * width / max(n, 1)) + 0.3
    cholesky = sigma * (uniform(batch, n, 3) + torch.tensor([0.3, -0.5, 0.3]))
    index, table = None, None
    if regions > 1:
        y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        labels = ((x > width // 2) + 2 * (y > height // 2)) % regions
        labels = torch.stack([labels.roll(3 * i, 1) for i in range(maps)]).to(DEVICE)
        widths, width_index = find_widths(labels.int(), regions, softness)
        table = with_positions(MapTable(labels, blurs_of(widths, DEVICE), width_index))
        index = torch.randint(-1, regions, (batch, n), generator=generator).to(DEVICE)
    arrays = (t.to(DEVICE) for t in (means, cholesky, uniform(batch, n, channels) - 0.3))
    return SplatInputs(*arrays, index, table, size, cutoff)


def with_ids(inputs: SplatInputs) -> SplatInputs:
    """Return the same with ids, 5, 8, 11 ..., and 7 where there is no region, in place of positions."""
    if inputs.region_positions is None or inputs.table is None:
        return inputs
    region_ids = torch.where(inputs.region_positions >= 0, 3 * inputs.region_positions + 5, 7)
    table = inputs.table._replace(ids=3 * torch.arange(inputs.table.num_regions, device=DEVICE) + 5)
    return inputs._replace(region_positions=None, table=table, region_ids=region_ids)


def probe(inputs: SplatInputs) -> Tensor:
    """Make a gradient of the image, of both signs."""
    shape = (len(inputs.means), inputs.colors.shape[-1], *inputs.size)
    return torch.linspace(-1, 2, math.prod(shape), dtype=inputs.means.dtype, device=DEVICE).view(shape)


def evaluate(kernel: ModuleType, inputs: SplatInputs) -> list[Tensor]:
    """Return the image and the gradients."""
    inputs = with_ids(inputs) if kernel is cuda else inputs
    steps = kernel.kernel_for(inputs)
    lists = steps.plan(inputs)
    return [steps.render(lists, inputs), *steps.differentiate(lists, inputs, probe(inputs), True)]


def to_double(inputs: SplatInputs) -> SplatInputs:
    return SplatInputs(*(t.double() for t in inputs.gaussians), *inputs[3:])


def assert_close(got: list[Tensor], want: list[Tensor], tolerance: float) -> None:
    for a, b in zip(got, want, strict=True):
        assert a.dtype == torch.float32 and a.shape == b.shape
        assert b.abs().max() > 1e-3
        assert (a.double() - b).abs().max() <= tolerance * b.abs().max()
        cosine = torch.nn.functional.cosine_similarity(a.double().flatten(), b.flatten(), dim=0)
        assert cosine >= 1 - tolerance


# no map, hard and soft contours; one map and one for each image; one channel, a block, more than a block
@pytest.mark.parametrize(
    "case",
    [
        {"size": (1, 1)},
        {"size": (15, 17), "regions": 2, "channels": 1, "cutoff": 1e-3, "n": 9},
        {"size": (20, 5), "regions": 3, "softness": 0.7, "batch": 2, "channels": 5, "n": 5},
        {"size": (34, 20), "regions": 4, "softness": {(0, 1): 0.6, (1, 3): 2.0}, "batch": 2, "maps": 2, "n": 3},
        *([{"size": (40, 52), "regions": 3, "softness": 0.7, "batch": 3, "maps": 3, "n": 300}] if GPU else []),
        *([{"size": (300, 400), "regions": 3, "n": 700, "batch": 2, "cutoff": 1e-4, "channels": 32}] if GPU else []),
    ],
    ids=str,
)
def test_agrees_with_the_reference(case: dict[str, Any]) -> None:
    inputs = make_inputs(**case)
    assert_close(evaluate(cuda, inputs), evaluate(reference, to_double(inputs)), 5e-6)


def test_error() -> None:
    """The gradients of half the squared error are those of its image, render minus target."""
    inputs = make_inputs(4, (9, 5), regions=2, softness=0.5)
    target = 0.5 * probe(inputs)
    double = to_double(inputs)
    error = reference.kernel_for(double).render(None, double) - target
    want = reference.kernel_for(double).differentiate(None, double, error, True)
    inputs = with_ids(inputs)
    steps = cuda.kernel_for(inputs)
    assert steps.error_gradients is not None
    assert_close([*steps.error_gradients(steps.plan(inputs), inputs, target)], [*want], 5e-6)


def test_more_than_a_block_in_a_tile() -> None:
    """130 Gaussians of one tile, needles, giants and dots among them, and some outside of the image."""
    inputs = make_inputs(130, size=(4, 2), channels=1)
    scales = 10.0 ** torch.linspace(-2, 5, 130, device=DEVICE)
    cholesky = inputs.cholesky.clone()
    cholesky[0, ::3] = torch.tensor([0.7, 0.2, 0.5], device=DEVICE)
    cholesky[0, 1::3, 0] = scales[1::3]
    cholesky[0, 2::3, 2] = scales[2::3]
    inputs = inputs._replace(cholesky=cholesky, colors=inputs.colors / 130)
    got, want = evaluate(cuda, inputs), evaluate(reference, to_double(inputs))
    assert (got[0] - want[0]).abs().max() <= 5e-6
    assert all(torch.isfinite(t).all() for t in got)
    assert_close([got[3]], [want[3]], 2e-5)


def test_gradient_layouts_and_colours_alone() -> None:
    inputs = make_inputs(4, (5, 3))
    steps = cuda.kernel_for(inputs)
    lists = steps.plan(inputs)
    ones = torch.ones(1, 3, *inputs.size, device=DEVICE)
    gradients = steps.differentiate(lists, inputs, ones, True)
    for layout in (ones[0, 0, 0, 0].expand(ones.shape), ones.permute(0, 2, 3, 1).contiguous().permute(0, 3, 1, 2)):
        assert torch.equal(steps.differentiate(lists, inputs, layout, True)[0], gradients[0])
    assert gradients[0].any()
    means, cholesky, colors = steps.differentiate(lists, inputs, ones, False)
    assert means is None and cholesky is None and torch.equal(colors, gradients[2])


@pytest.mark.parametrize(("count", "regions"), [(0, 1), (3, 2)])
def test_nothing_to_render(count: int, regions: int) -> None:
    inputs = make_inputs(count, regions=regions)
    inputs = inputs._replace(means=torch.full_like(inputs.means, 1e6))
    image, *gradients = evaluate(cuda, inputs)
    assert torch.equal(image, torch.zeros(1, 3, 16, 20, device=DEVICE))
    for gradient, array in zip(gradients, inputs.gaussians, strict=True):
        assert torch.equal(gradient, torch.zeros_like(array))


@needs_gpu  # the interpreter runs one program after the other
def test_same_bits_every_time() -> None:
    inputs = make_inputs(4000, (270, 480), regions=3, softness=0.7)
    first = evaluate(cuda, inputs)
    for _ in range(5):
        assert all(torch.equal(a, b) for a, b in zip(first, evaluate(cuda, inputs), strict=True))


# room for lists


def test_without_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    """A plan that does not wait has room for 1.5 times the most; beyond that all is NaN until there is more room."""
    monkeypatch.setattr(capacity, "_SPARE_SLOTS", 1)
    capacity._max_slots.clear()
    dot = torch.tensor([0.1, 0.0, 0.1], device=DEVICE)
    inputs = make_inputs(2, (48, 2))._replace(cholesky=dot.expand(1, 2, 3))
    large = inputs._replace(cholesky=40 * inputs.cholesky)
    expected = evaluate(cuda, inputs)
    with without_waiting():
        assert all(torch.equal(a, b) for a, b in zip(evaluate(cuda, inputs), expected, strict=True))
        assert not settle(inputs.means.device, inputs.num_images, inputs.size)
        assert all(t.isnan().all() for t in evaluate(cuda, large))
        assert settle(inputs.means.device, inputs.num_images, inputs.size)
        assert all(t.isfinite().all() for t in evaluate(cuda, large))
        assert not settle(inputs.means.device, inputs.num_images, inputs.size)
        assert evaluate(cuda, inputs._replace(colors=inputs.colors / 0))[0].isnan().all()
        evaluate(cuda, inputs)
    assert settle(inputs.means.device, inputs.num_images, inputs.size)
    capacity.notes_of(inputs.means.device)[1] = 1
    with pytest.warns(UserWarning, match="1 renders of a CUDA graph are NaN: their Gaussians were not finite"):
        evaluate(cuda, inputs)
    evaluate(cuda, inputs)


def test_too_many_slots() -> None:
    inputs = make_inputs(9, size=(1 << 18, 1 << 18))
    inputs = inputs._replace(cholesky=torch.full_like(inputs.cholesky, 1e6))
    message = r"9 Gaussians touch 2415919104 tiles of 16 x 16 pixels at 262144 x 262144: more than the device has room"
    with pytest.raises(ValueError, match=message):
        plan.plan(inputs)
    with pytest.raises(ValueError, match=r"size must be at most 524272 on backend 'cuda'; got \(1, 524288\)"):
        plan.plan(inputs._replace(size=(1, 1 << 19)))


# the operator


def small_splat(**changes: Tensor) -> dict[str, Any]:
    labels = (torch.arange(16, device=DEVICE) // 9).expand(8, 16).contiguous()
    arguments = {
        "means": torch.tensor([[4.0, 4.0], [12.0, 4.0]], device=DEVICE),
        "cholesky": torch.tensor([[2.0, 0.0, 2.0], [3.0, 1.0, 2.0]], device=DEVICE),
        "colors": torch.ones(2, 3, device=DEVICE),
        "region_ids": torch.tensor([0, 1], device=DEVICE),
        "regions": RegionMap(labels, 0.7),
    }
    return {**arguments, **changes, "backend": "cuda"}


def test_refuses_what_the_cpu_refuses() -> None:
    """An error or a warning comes at the call, and the next call is as good as ever."""
    expected = region_splat(**small_splat())
    with pytest.raises(ValueError, match="means must be finite"):
        region_splat(**small_splat(means=torch.full((2, 2), math.nan, device=DEVICE)))
    with pytest.raises(ValueError, match="colors must be finite"):
        region_splat(**small_splat(colors=torch.full((2, 3), math.inf, device=DEVICE)))
    with pytest.raises(ValueError, match=r"cholesky must be .* \[-1, 2\]"):
        region_splat(**small_splat(cholesky=torch.tensor([[-1.0, 0, 1], [1, 0, 2]], device=DEVICE)))
    with pytest.raises(ValueError, match="region_ids must be non-negative; got -2"):
        region_splat(**small_splat(region_ids=torch.tensor([0, -2], device=DEVICE)))
    with pytest.warns(
        UserWarning, match="1 of 2 Gaussians paint nothing: regions does not hold their region ids, such"
    ):
        region_splat(**small_splat(region_ids=torch.tensor([0, 9], device=DEVICE)))
    assert torch.equal(region_splat(**small_splat()), expected)


def test_operator() -> None:
    results = []
    for backend in ("cuda", "reference"):
        arguments = {**small_splat(), "backend": backend}
        leaves = [arguments[name].requires_grad_() for name in ("means", "cholesky", "colors")]
        image = region_splat(**arguments)
        results.append([image.detach(), *torch.autograd.grad(image.square().sum(), leaves)])
    for a, b in zip(*results, strict=True):
        assert b.any() and (a - b).abs().max() <= 1e-5 * b.abs().max()


@pytest.mark.skipif(GPU, reason="there a profiler counts the steps of copies, too")
def test_number_of_launches(monkeypatch: pytest.MonkeyPatch) -> None:
    """A forward takes at most 6 launches and 12 operations of torch, a backward 3 and 8; launches do nothing here."""
    launches: list[str] = []

    def launch(name: str) -> Callable[..., None]:
        return lambda *arguments, **constants: launches.append(name)

    def count(action: Callable[[], Any]) -> tuple[Any, int, int]:
        launches.clear()
        with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU], acc_events=True) as profile:
            result = action()
        operations = [e for e in profile.events() if e.name.startswith("aten::")]
        return result, len(launches), len(operations)

    arguments = small_splat()
    leaves = [arguments[name].requires_grad_() for name in ("means", "cholesky", "colors")]
    region_splat(**arguments)
    for module, names in (
        (plan, ("_prepare", "_bin", "_tile")),
        (render, ("_render",)),
        (gather, ("_gather", "_reduce")),
    ):
        for name in names:
            monkeypatch.setattr(module, name, launch(name))
    image, programs, operations = count(lambda: region_splat(**arguments))
    assert programs <= 6 and operations <= 12
    grad = torch.ones_like(image)
    _, programs, operations = count(lambda: torch.autograd.grad(image, leaves, grad))
    assert programs <= 3 and operations <= 8


# CUDA graphs


def train(field: GaussianField, target: Tensor, steps: int, captured: bool) -> Tensor:
    """Train a field, eagerly or by the replays of a CUDA graph, and return its means."""
    renderer, optimizer = RegionSplatRenderer(), GaussianAdam(field)

    def step() -> None:
        optimizer.zero_grad(set_to_none=False)
        (renderer(field) - target).square().mean().backward()
        optimizer.step()

    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(3):
            step()
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    if captured:
        with torch.cuda.graph(graph):
            step()
    for _ in range(steps):
        if captured:
            graph.replay()
        else:
            step()
    return field.means.detach().clone()


@needs_gpu
def test_graph_of_a_step() -> None:
    target = torch.rand(1, 3, 64, 96, device=DEVICE)
    means = [train(GaussianField.random(200, (64, 96), seed=0).to(DEVICE), target, 20, c) for c in (False, True)]
    assert torch.equal(means[0], means[1])


@needs_gpu
def test_graph_is_nan_where_lists_do_not_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(capacity, "_SPARE_SLOTS", 1)
    capacity._max_slots.clear()
    inputs = make_inputs(50, size=(64, 64))._replace(
        cholesky=torch.tensor([0.5, 0.0, 0.5], device=DEVICE).expand(1, 50, 3)
    )
    cholesky = inputs.cholesky.clone()

    def action() -> Tensor:
        return region_splat(inputs.means, cholesky, inputs.colors, size=inputs.size, backend="cuda")

    with torch.cuda.graph(torch.cuda.CUDAGraph()):
        cholesky.add_(0.0)
        with pytest.raises(RuntimeError, match="cannot be captured before it was rendered once"):
            action()
    expected = action()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        image = action()
    graph.replay()
    assert torch.equal(image, expected)
    cholesky.mul_(40.0)
    graph.replay()
    assert image.isnan().all()
    with pytest.warns(UserWarning, match="renders of a CUDA graph are NaN: their Gaussians touch up to"):
        assert action().isfinite().all()


@needs_gpu
@pytest.mark.filterwarnings("ignore:The CUDA Graph is empty")  # torch's own, at its first graph
def test_compiled_step() -> None:
    regions = RegionMap((torch.arange(64, device=DEVICE) // 25).expand(48, 64), 0.7)
    field = GaussianField.random(100, (48, 64), regions=regions, seed=0).to(DEVICE)
    target, renderer = torch.rand(1, 3, 48, 64, device=DEVICE), RegionSplatRenderer()

    def loss() -> Tensor:
        return (renderer(field, regions) - target).square().mean()

    expected = torch.autograd.grad(loss(), [*field.parameters()])
    compiled = torch.compile(loss, mode="reduce-overhead")
    for _ in range(4):
        torch.compiler.cudagraph_mark_step_begin()
        gradients = [g.clone() for g in torch.autograd.grad(compiled(), [*field.parameters()])]
    for a, b in zip(gradients, expected, strict=True):
        assert (a - b).abs().max() <= 1e-5 * b.abs().max()


@needs_gpu
def test_backward_waits_for_nothing() -> None:
    """Nor does a captured or a fit's forward, which `test_without_waiting` has."""
    arguments = small_splat()
    leaves = [arguments[name].requires_grad_() for name in ("means", "cholesky", "colors")]
    image = region_splat(**arguments)
    grad = torch.ones_like(image)
    torch.cuda.set_sync_debug_mode("error")
    try:
        torch.autograd.grad(image, leaves, grad)
    finally:
        torch.cuda.set_sync_debug_mode("default")
