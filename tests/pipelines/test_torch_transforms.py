"""The renderer among torch's own machinery: compile, functional calls, transforms, data parallel, pickle, deepcopy."""

from __future__ import annotations

import copy
import io
import pickle
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from kcgs import GaussianField, RegionMap, RegionSplatRenderer
from kcgs.functional import region_splat

SIZE = (24, 32)
# the CPU kernel and the tiled one have a backward of their own, which torch.func cannot transform
TRANSFORMS_REFUSED = "autograd.Function with functorch transforms"


def compiler_warnings(test: Callable[..., None]) -> Callable[..., None]:
    """Let pass what the compiler itself sets off inside torch, on its first use and as it traces and breaks graphs."""
    for words in (
        "ignore:The .grad attribute of a Tensor that is not a leaf:UserWarning",
        "ignore:.*torch.autograd.function.Function.* should not be instantiated:DeprecationWarning",
        "ignore:`torch.jit.script.*` is deprecated:DeprecationWarning",
    ):
        test = pytest.mark.filterwarnings(words)(test)
    return test


@pytest.fixture
def regions() -> RegionMap:
    labels = torch.zeros(SIZE, dtype=torch.long)
    labels[6:18, 10:26] = 3
    return RegionMap.from_labels(labels, 0.8)


@pytest.fixture
def field(regions: RegionMap) -> GaussianField:
    return GaussianField.random(20, SIZE, regions=regions, seed=0)


class Picture(nn.Module):
    """A field, the renderer and an ordinary layer: what a user would train."""

    def __init__(self, field: GaussianField, regions: RegionMap, backend: str = "auto") -> None:
        super().__init__()
        self.field, self.regions = field, regions
        self.render = RegionSplatRenderer(backend=backend)
        self.tone = nn.Conv2d(3, 3, 1)

    def forward(self, exposure: Tensor) -> Tensor:
        return self.tone(exposure * self.render(self.field, self.regions)[None]).sigmoid()


def value_and_gradients(module: nn.Module, exposure: Tensor) -> list[Tensor]:
    picture = module(exposure)
    return [picture.detach(), *torch.autograd.grad(picture.square().sum(), list(module.parameters()))]


class TestCompile:
    @pytest.fixture(autouse=True)
    def fresh(self) -> Iterator[None]:
        torch._dynamo.reset()
        yield
        torch._dynamo.reset()

    @compiler_warnings
    @pytest.mark.parametrize("name", ["eager", "aot_eager"])
    def test_equals_eager(self, field: GaussianField, regions: RegionMap, backend: str, name: str) -> None:
        """The checks of values break the graph; picture and gradients stay."""
        torch.manual_seed(0)
        module = Picture(field, regions, backend)
        compiled = torch.compile(module, backend=name)
        for exposure in (torch.ones(1), torch.full((1,), 0.5)):
            want = value_and_gradients(module, exposure)
            for got, expected in zip(value_and_gradients(compiled, exposure), want, strict=True):
                torch.testing.assert_close(got, expected, rtol=1e-5, atol=1e-6)

    @compiler_warnings
    def test_follows_training(self, field: GaussianField, regions: RegionMap) -> None:
        """A compiled module sees every step of the optimiser: nothing of the field is baked in."""
        torch.manual_seed(0)
        module = Picture(field, regions)
        compiled = torch.compile(module, backend="eager")
        optimizer = torch.optim.SGD(module.parameters(), lr=0.1)
        for _ in range(3):
            picture = compiled(torch.ones(1))
            torch.testing.assert_close(picture, module(torch.ones(1)), rtol=1e-6, atol=1e-6)
            optimizer.zero_grad()
            picture.square().sum().backward()
            optimizer.step()

    @compiler_warnings
    def test_one_whole_graph_is_refused(self, field: GaussianField, regions: RegionMap) -> None:
        compiled = torch.compile(RegionSplatRenderer(), backend="eager", fullgraph=True)
        # which of the two depends on what was compiled before
        with pytest.raises((torch._dynamo.exc.Unsupported, torch._dynamo.exc.UserError), match="data-dependent|item"):
            compiled(field, regions)


class TestFunctional:
    def test_functional_call(self, field: GaussianField, regions: RegionMap, backend: str) -> None:
        """Other parameters through the same module, the field's own untouched."""
        module = Picture(field, regions, backend)
        before = field.colors.detach().clone()
        swapped = {name: p.detach().clone() for name, p in module.named_parameters()}
        swapped["field.colors"] = (0.5 * swapped["field.colors"]).requires_grad_()
        got = torch.func.functional_call(module, swapped, (torch.full((1,), 2.0),))
        torch.testing.assert_close(got, module(torch.ones(1)), rtol=1e-5, atol=1e-6)
        got.sum().backward()
        assert swapped["field.colors"].grad is not None and swapped["field.colors"].grad.any()
        assert field.colors.grad is None and torch.equal(field.colors, before)

    def test_grad_and_vjp_through_reference(self, field: GaussianField, regions: RegionMap) -> None:
        module = Picture(field, regions, "reference")
        parameters = {name: p.detach() for name, p in module.named_parameters()}

        def loss(values: dict[str, Tensor]) -> Tensor:
            return torch.func.functional_call(module, values, (torch.ones(1),)).square().sum()

        want = dict(zip(parameters, value_and_gradients(module, torch.ones(1))[1:], strict=True))
        for name, got in torch.func.grad(loss)(parameters).items():
            torch.testing.assert_close(got, want[name], rtol=1e-5, atol=1e-6)
        _, pull = torch.func.vjp(loss, parameters)
        torch.testing.assert_close(pull(torch.tensor(2.0))[0]["field.means"], 2 * want["field.means"])

    @pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning")  # torch's own first use
    def test_jvp_through_reference(self, field: GaussianField, regions: RegionMap) -> None:
        """The picture is linear in the colours: its derivative along a colour is the picture of that colour."""
        along = torch.rand(field.colors.shape, generator=torch.Generator().manual_seed(1))

        def draw(colors: Tensor) -> Tensor:
            return region_splat(field.means, field.cholesky, colors, field.region_ids, regions, backend="reference")

        _, derivative = torch.func.jvp(draw, (field.colors.detach(),), (along,))
        torch.testing.assert_close(derivative, draw(along), rtol=1e-5, atol=1e-6)

    @pytest.mark.parametrize("kernel", ["tiled", "cpu"])
    def test_grad_is_refused_elsewhere(self, field: GaussianField, regions: RegionMap, kernel: str) -> None:
        def loss(colors: Tensor) -> Tensor:
            return region_splat(
                field.means.detach(), field.cholesky.detach(), colors, field.region_ids, regions, backend=kernel
            ).sum()

        with pytest.raises(RuntimeError, match=TRANSFORMS_REFUSED):
            torch.func.grad(loss)(field.colors.detach())

    def test_vmap_is_refused_and_a_batch_does_it(self, field: GaussianField, regions: RegionMap, backend: str) -> None:
        """Values are checked before anything is drawn, which vmap cannot do; (B, N, ...) draws all at once."""
        means, cholesky, ids = field.means.detach(), field.cholesky.detach(), field.region_ids
        assert ids is not None
        colors = torch.rand(4, *field.colors.shape, generator=torch.Generator().manual_seed(1))
        with pytest.raises(RuntimeError, match="vmap"):
            torch.func.vmap(lambda c: region_splat(means, cholesky, c, ids, regions, backend=backend))(colors)
        batched = [t.expand(4, *t.shape) for t in (means, cholesky, ids)]
        got = region_splat(batched[0], batched[1], colors, batched[2], regions, backend=backend)
        for picture, c in zip(got, colors, strict=True):
            want = region_splat(means, cholesky, c, ids, regions, backend=backend)
            torch.testing.assert_close(picture, want, rtol=1e-5, atol=1e-5)


class TestState:
    def test_renderer_has_none(self, field: GaussianField, regions: RegionMap) -> None:
        render = RegionSplatRenderer()
        before = {name: value for name, value in vars(render).items() if not name.startswith("_")}
        render(field, regions).sum().backward()
        assert not list(render.parameters()) and not list(render.buffers()) and not render.state_dict()
        assert {name: value for name, value in vars(render).items() if not name.startswith("_")} == before

    def test_state_dict_round_trip(self, field: GaussianField, regions: RegionMap) -> None:
        torch.manual_seed(0)
        module, file = Picture(field, regions), io.BytesIO()
        torch.save(module.state_dict(), file)
        file.seek(0)
        other = Picture(GaussianField.random(20, SIZE, regions=regions, seed=5), regions)
        assert not torch.equal(other(torch.ones(1)), module(torch.ones(1)))
        missing, unexpected = other.load_state_dict(torch.load(file, weights_only=True))
        assert not missing and not unexpected
        assert torch.equal(other(torch.ones(1)), module(torch.ones(1)))

    @pytest.mark.parametrize("clone", [copy.deepcopy, lambda m: pickle.loads(pickle.dumps(m))])
    @pytest.mark.parametrize("drawn", [False, True])
    def test_copies_draw_the_same(self, field: GaussianField, regions: RegionMap, clone: object, drawn: bool) -> None:
        """The label map goes along, before and after the tables of a first picture are made."""
        module = Picture(field, regions)
        if drawn:
            module(torch.ones(1))
        other = clone(module)  # type: ignore[operator]
        got, want = (value_and_gradients(m, torch.ones(1)) for m in (other, module))
        assert all(torch.equal(a, b) for a, b in zip(got, want, strict=True))
        with torch.no_grad():
            other.field.colors.zero_()
        assert torch.equal(module(torch.ones(1)).detach(), want[0])

    @pytest.mark.skipif(not torch.distributed.is_available(), reason="torch is built without distributed")
    def test_data_parallel(self, field: GaussianField, regions: RegionMap, tmp_path: Path) -> None:
        """One process of a group: the wrapped module draws and trains as the module does, integer ids and all."""
        torch.manual_seed(0)
        alone = Picture(copy.deepcopy(field), regions)
        torch.distributed.init_process_group("gloo", init_method=f"file://{tmp_path}/group", rank=0, world_size=1)
        try:
            wrapped = nn.parallel.DistributedDataParallel(copy.deepcopy(alone))
            optimizers = [torch.optim.SGD(m.parameters(), lr=0.1) for m in (alone, wrapped)]
            for _ in range(3):
                pictures = [m(torch.ones(1)) for m in (alone, wrapped)]
                assert torch.equal(*pictures)
                for picture, optimizer in zip(pictures, optimizers, strict=True):
                    optimizer.zero_grad()
                    picture.square().sum().backward()
                    optimizer.step()
            state = wrapped.module.state_dict()
        finally:
            torch.distributed.destroy_process_group()
        for name, value in alone.state_dict().items():
            if isinstance(value, Tensor):
                assert torch.equal(value, state[name]), name
