"""The renderer among torch's own machinery: compile, functional calls, transforms, data parallel, pickle, deepcopy."""

from __future__ import annotations

import copy
import io
import pickle
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
import torch._dynamo.testing
from torch import Tensor, nn

from kcgs import GaussianField, RegionMap, RegionSplatRenderer, Scene
from kcgs.functional import region_splat

SIZE = (24, 32)


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
    @pytest.mark.parametrize("name", ["eager", "aot_eager"])
    def test_one_whole_graph_for_all_numbers_and_maps(self, regions: RegionMap, name: str) -> None:
        counter = torch._dynamo.testing.CompileCounterWithBackend(name)
        compiled = torch.compile(region_splat, backend=counter, fullgraph=True, dynamic=True)
        maps = [regions, RegionMap.from_labels(3 - regions.labels, 0.5)]
        first = 0
        for count in (20, 12, 31):
            for of in maps:
                field = GaussianField.random(count, SIZE, regions=of, seed=count)
                tensors = field.means.detach(), field.cholesky.detach(), field.colors.detach(), field.region_ids
                assert torch.equal(compiled(*tensors, of), region_splat(*tensors, of))
                first = first or counter.frame_count
        assert counter.frame_count == first

    @compiler_warnings
    def test_a_training_step_with_kornia_in_one_graph(self, field: GaussianField, regions: RegionMap) -> None:
        import kornia

        chain = nn.Sequential(RegionSplatRenderer(keepdim=False), kornia.filters.GaussianBlur2d((3, 3), (1.0, 1.0)))
        scene = Scene(field, regions)

        def loss() -> Tensor:
            return kornia.losses.charbonnier_loss(chain(scene), torch.zeros(1, 3, *SIZE), reduction="mean")

        want = torch.autograd.grad(loss(), list(scene.parameters()))
        got = torch.autograd.grad(torch.compile(loss, fullgraph=True, backend="aot_eager")(), list(scene.parameters()))
        for a, b in zip(got, want, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-7)

    @compiler_warnings
    def test_export(self, field: GaussianField, regions: RegionMap, tmp_path: Path) -> None:
        """Saved and loaded, a program renders the scene with the map that it holds."""
        scene = Scene(field, regions)
        torch.export.save(torch.export.export(scene, ()), tmp_path / "scene.pt2")
        assert torch.equal(torch.export.load(tmp_path / "scene.pt2").module()(), scene())


class TestOperator:
    @compiler_warnings
    @pytest.mark.parametrize("kernel", ["cpu", "tiled", "reference"])
    def test_opcheck(self, field: GaussianField, regions: RegionMap, kernel: str) -> None:
        gaussians = [t.detach()[None].clone().requires_grad_() for t in (field.means, field.cholesky, field.colors)]
        settings = (field.region_ids[None], regions.fine_labels, regions.widths, 1, *SIZE, 1e-4, kernel)
        torch.library.opcheck(torch.ops.kcgs.region_splat.default, (*gaussians, *settings))
        grad = torch.rand(1, 3, *SIZE, requires_grad=kernel == "reference")
        gaussians = gaussians if kernel == "reference" else [t.detach() for t in gaussians]
        torch.library.opcheck(torch.ops.kcgs.region_splat_backward.default, (grad, *gaussians, *settings, True))

    def test_meta(self, field: GaussianField, regions: RegionMap) -> None:
        tensors = field.means, field.cholesky, field.colors, field.region_ids, regions.labels
        image = region_splat(*(t.to("meta") for t in tensors))
        assert image.device.type == "meta" and image.shape == (3, *SIZE)

    @pytest.mark.parametrize("kernel", ["cpu", "tiled"])
    def test_second_derivatives_are_the_references(self, field: GaussianField, regions: RegionMap, kernel: str) -> None:
        def slope(backend: str) -> Tensor:
            image = RegionSplatRenderer(backend=backend)(field, regions)
            (first,) = torch.autograd.grad(image.square().sum(), field.colors, create_graph=True)
            return torch.autograd.grad(first.square().sum(), field.colors)[0]

        assert slope("reference").abs().max() > 0
        with pytest.raises(RuntimeError, match=f"backend '{kernel}' has first derivatives by backward only"):
            slope(kernel)

    @pytest.mark.parametrize("kernel", ["cpu", "tiled"])
    def test_maps_that_share_labels_keep_their_gradients(self, field: GaussianField, kernel: str) -> None:
        """Two renders of the same tensors before the first backward: each has the gradient of its own contours."""
        labels = torch.zeros(SIZE, dtype=torch.long)
        labels[:, 16:] = 3
        maps = [RegionMap.from_labels(labels, softness) for softness in (0.4, 4.0)]
        tensors = [t.detach()[None].clone() for t in (field.means, field.cholesky, field.colors)]
        tensors[2].requires_grad_()
        ids = field.region_ids[None]

        def draw(of: RegionMap) -> Tensor:
            return region_splat(*tensors, ids, of, backend=kernel).square().sum()

        want = [torch.autograd.grad(draw(of), tensors[2])[0] for of in maps]
        for image, gradient in zip([draw(of) for of in maps], want, strict=True):
            assert torch.equal(torch.autograd.grad(image, tensors[2])[0], gradient)
        assert not torch.equal(*want)

    def test_labels_that_change_in_place(self, field: GaussianField) -> None:
        labels = torch.zeros(SIZE, dtype=torch.long)
        labels[:, 16:] = 3
        gaussians = field.means, field.cholesky, field.colors, field.region_ids
        before = region_splat(*gaussians, labels)
        labels[:] = labels.flip(1)
        assert torch.equal(region_splat(*gaussians, labels), region_splat(*gaussians, labels.clone()))
        assert not torch.equal(region_splat(*gaussians, labels), before)


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

    @pytest.mark.parametrize("kernel", ["cpu", "tiled", "reference"])
    def test_grad_and_vjp(self, field: GaussianField, regions: RegionMap, kernel: str) -> None:
        module = Picture(field, regions, kernel)
        parameters = {name: p.detach() for name, p in module.named_parameters()}

        def loss(values: dict[str, Tensor]) -> Tensor:
            return torch.func.functional_call(module, values, (torch.ones(1),)).square().sum()

        want = dict(zip(parameters, value_and_gradients(module, torch.ones(1))[1:], strict=True))
        for name, got in torch.func.grad(loss)(parameters).items():
            torch.testing.assert_close(got, want[name], rtol=1e-5, atol=1e-6)
        _, pull = torch.func.vjp(loss, parameters)
        torch.testing.assert_close(pull(torch.tensor(2.0))[0]["field.means"], 2 * want["field.means"])

    @pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning")  # torch's own first use
    def test_jvp(self, field: GaussianField, regions: RegionMap) -> None:
        """The picture is linear in the colours: its derivative along a colour is the picture of that colour."""
        along = torch.rand(field.colors.shape, generator=torch.Generator().manual_seed(1))

        def draw(colors: Tensor, backend: str = "reference") -> Tensor:
            return region_splat(field.means, field.cholesky, colors, field.region_ids, regions, backend=backend)

        _, derivative = torch.func.jvp(draw, (field.colors.detach(),), (along,))
        torch.testing.assert_close(derivative, draw(along), rtol=1e-5, atol=1e-6)
        with pytest.raises(RuntimeError, match="backend 'cpu' has first derivatives by backward only"):
            torch.func.jvp(lambda colors: draw(colors, "cpu"), (field.colors.detach(),), (along,))

    def test_vmap_over_colors_gaussians_and_maps(self, field: GaussianField, regions: RegionMap, backend: str) -> None:
        means, cholesky, ids = field.means.detach(), field.cholesky.detach(), field.region_ids
        generator = torch.Generator().manual_seed(1)
        colors = torch.rand(4, *field.colors.shape, generator=generator)
        shifted = means + torch.rand(4, 1, 2, generator=generator)
        labels = torch.stack([regions.labels.roll(k, 1) for k in range(4)])

        def draw(c: Tensor, m: Tensor = means, of: RegionMap | Tensor = regions) -> Tensor:
            return region_splat(m, cholesky, c, ids, of, backend=backend)

        for mapped, singles in (
            (torch.func.vmap(draw)(colors), [draw(c) for c in colors]),
            (torch.func.vmap(draw)(colors, shifted), [draw(c, m) for c, m in zip(colors, shifted, strict=True)]),
            (
                torch.func.vmap(lambda of: draw(colors[0], means, of))(labels),
                [draw(colors[0], means, of) for of in labels],
            ),
        ):
            torch.testing.assert_close(mapped, torch.stack(singles), rtol=1e-5, atol=1e-5)
        rows = torch.func.vmap(torch.func.grad(lambda c: draw(c).square().sum()))(colors)
        one = torch.func.grad(lambda c: draw(c).square().sum())(colors[2])
        torch.testing.assert_close(rows[2], one, rtol=1e-4, atol=1e-4)


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
