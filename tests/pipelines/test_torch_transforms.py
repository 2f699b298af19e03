"""The renderer among torch's own machinery: compile, functional calls, transforms, data parallel, pickle, deepcopy."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch._dynamo.testing
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils.checkpoint import checkpoint

from kcgs import GaussianField, RegionMap, RegionSplatRenderer, Scene
from kcgs.functional import lookup_regions, region_splat
from kcgs.maps import table_and_size

SIZE = (24, 32)


def compiler_warnings(test: Callable[..., None]) -> Callable[..., None]:
    """Let pass what the compiler itself sets off inside torch, on its first use and as it traces and breaks graphs."""
    for words in (
        "ignore:The .grad attribute of a Tensor that is not a leaf:UserWarning",
        "ignore:.*torch.autograd.function.Function.* should not be instantiated:DeprecationWarning",
    ):
        test = pytest.mark.filterwarnings(words)(test)
    return test


@pytest.fixture
def regions() -> RegionMap:
    labels = torch.zeros(SIZE, dtype=torch.long)
    labels[6:18, 10:26] = 3
    return RegionMap(labels, 0.8)


@pytest.fixture
def field(regions: RegionMap) -> GaussianField:
    return GaussianField.random(20, SIZE, regions=regions, seed=0)


class Exposure(nn.Module):
    """A field, the renderer and an ordinary layer: what a user would train."""

    def __init__(self, field: GaussianField, regions: RegionMap, backend: str = "auto") -> None:
        super().__init__()
        self.field, self.regions = field, regions
        self.render = RegionSplatRenderer(backend=backend)
        self.tone = nn.Conv2d(3, 3, 1)

    def forward(self, exposure: Tensor) -> Tensor:
        return self.tone(exposure * self.render(self.field, self.regions)[None]).sigmoid()


def image_and_gradients(module: nn.Module, exposure: Tensor) -> list[Tensor]:
    picture = module(exposure)
    return [picture.detach(), *torch.autograd.grad(picture.square().sum(), list(module.parameters()))]


class TestCompile:
    @pytest.fixture(autouse=True)
    def fresh(self) -> Iterator[None]:
        torch._dynamo.reset()
        yield
        torch._dynamo.reset()

    @compiler_warnings
    def test_follows_training(self, field: GaussianField, regions: RegionMap, backend: str) -> None:
        """Image and gradients are those of eager mode after each step: nothing of the field is baked in."""
        torch.manual_seed(0)
        module = Exposure(field, regions, backend)
        compiled = torch.compile(module, backend="aot_eager")
        for exposure in (torch.ones(1), torch.full((1,), 0.5)):
            eager = image_and_gradients(module, exposure)
            for result, expected in zip(image_and_gradients(compiled, exposure), eager, strict=True):
                torch.testing.assert_close(result, expected, rtol=1e-5, atol=1e-6)
            with torch.no_grad():
                for parameter, gradient in zip(module.parameters(), eager[1:], strict=True):
                    parameter.sub_(0.1 * gradient)

    @compiler_warnings
    def test_a_training_step_with_kornia_in_one_graph(self, field: GaussianField, regions: RegionMap) -> None:
        import kornia

        chain = nn.Sequential(RegionSplatRenderer(keepdim=False), kornia.filters.GaussianBlur2d((3, 3), (1.0, 1.0)))
        scene = Scene(field, regions)

        def loss() -> Tensor:
            return kornia.losses.charbonnier_loss(chain(scene), torch.zeros(1, 3, *SIZE), reduction="mean")

        compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
        gradients = (torch.autograd.grad(function(), list(scene.parameters())) for function in (compiled, loss))
        for gradient, eager in zip(*gradients, strict=True):
            torch.testing.assert_close(gradient, eager, rtol=1e-5, atol=1e-7)

    @compiler_warnings
    @pytest.mark.parametrize("name", ["aot_eager", "inductor"])
    def test_one_graph_for_all_sizes(self, name: str) -> None:
        """Forward and backward, without a map and with one."""
        counter = torch._dynamo.testing.CompileCounterWithBackend(name)
        compiled = torch.compile(region_splat, backend=counter, fullgraph=True, dynamic=True)
        counts = []
        for count, size in ((20, SIZE), (12, (31, 20)), (31, (16, 50))):
            labels = (torch.arange(size[1]) > 9).long().expand(size).contiguous()
            field = GaussianField.random(count, size, regions=labels, seed=count)
            leaves = [t.detach().requires_grad_() for t in (field.means, field.cholesky, field.colors)]
            for regions, options in (((), {"size": size}), ((field.region_ids, labels), {})):
                image, eager = (splat(*leaves, *regions, **options) for splat in (compiled, region_splat))  # type: ignore[arg-type]
                assert torch.equal(image, eager) and eager.abs().max() > 0.1
                gradients = (torch.autograd.grad(t.square().sum(), leaves) for t in (image, eager))
                assert all(torch.equal(a, b) for a, b in zip(*gradients, strict=True))
            counts.append(counter.frame_count)
        assert counts[0] == counts[2]

    @compiler_warnings
    @pytest.mark.parametrize("softness", [0.0, 0.8])
    def test_batches_of_any_number_with_maps_of_their_own(self, softness: float) -> None:
        compiled = torch.compile(region_splat, backend="aot_eager", fullgraph=True, dynamic=True)
        for batch, count in ((2, 3), (3, 7), (2, 2)):
            labels = (torch.arange(SIZE[1]) > 5 + torch.arange(batch)[:, None, None]).long().expand(-1, *SIZE)
            regions = RegionMap(labels, softness)
            field = GaussianField.stack(
                [GaussianField.random(count, SIZE, regions=labels[k], seed=k) for k in range(batch)]
            )
            leaves = [t.detach().requires_grad_() for t in (field.means, field.cholesky, field.colors)]
            image, eager = (splat(*leaves, field.region_ids, regions) for splat in (compiled, region_splat))
            assert image.shape == (batch, 3, *SIZE) and torch.equal(image, eager)
            gradients = (torch.autograd.grad(t.square().sum(), leaves) for t in (image, eager))
            assert all(torch.equal(a, b) for a, b in zip(*gradients, strict=True))

    @compiler_warnings
    @pytest.mark.parametrize("whole", [False, True])
    def test_modules_at_any_size(self, field: GaussianField, regions: RegionMap, whole: bool) -> None:
        scene, counts = Scene(field, regions), []
        counter = torch._dynamo.testing.CompileCounterWithBackend("aot_eager")
        module, arguments = (scene, ()) if whole else (RegionSplatRenderer(), (scene,))
        compiled = torch.compile(module, backend=counter, fullgraph=True)
        for size in (None, (48, 72), (30, 20), (31, 50)):  # its own size, a first other one, and any
            image, eager = (m(*arguments, size=size) for m in (compiled, module))
            torch.testing.assert_close(image, eager, rtol=1e-5, atol=1e-6)
            gradients = (torch.autograd.grad(t.sum(), list(scene.parameters())) for t in (image, eager))
            for gradient, expected in zip(*gradients, strict=True):
                torch.testing.assert_close(gradient, expected, rtol=1e-4, atol=1e-5)
            counts.append(counter.frame_count)
        assert counts[3] == counts[2] <= 3

    @compiler_warnings
    @pytest.mark.parametrize("predicted", [False, True])
    def test_scenes_of_any_number_of_gaussians(self, predicted: bool) -> None:
        """torch takes shapes of a module's tensors for constants unless told otherwise: then one graph serves all.

        But a map of one region has a graph of its own, as have tensors whose sizes are equal by chance.
        """
        counter = torch._dynamo.testing.CompileCounterWithBackend("aot_eager")
        compiled, counts = torch.compile(RegionSplatRenderer(), backend=counter, fullgraph=True, dynamic=True), []
        options = {"force_parameter_static_shapes": False, "force_nn_module_property_static_shapes": False}
        for count in (20, 12, 30):
            for softness in (1.1, 1.6):
                regions = RegionMap((torch.arange(SIZE[1]) > count).long().expand(SIZE), softness)
                field = GaussianField.random(count, SIZE, regions=regions, seed=0)
                if predicted:  # buffers, part of a graph
                    tensors = (1 * p for p in field.parameters())
                    field = GaussianField(*tensors, field.region_ids, size=SIZE)
                scene = Scene(field, regions)
                with torch._dynamo.config.patch(options):
                    assert torch.equal(compiled(scene), scene())
                counts.append(counter.frame_count)
        assert counts[0] == counts[5]


class Encoder(nn.Module):
    """The least network from a batch of images, each with its label map, to what they look like as Gaussians."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(3, 8, 3, stride=2), nn.AdaptiveAvgPool2d(3), nn.Flatten(), nn.Linear(72, 80)
        )

    def forward(self, images: Tensor, labels: Tensor) -> Tensor:
        raw = self.layers(images).unflatten(1, (10, 8))
        means, cholesky = raw[..., :2].sigmoid() * 24, nn.functional.softplus(raw[..., 2:5]) + 0.5

        field = GaussianField(means, cholesky, raw[..., 5:], size=SIZE).assign_regions(labels)
        return RegionSplatRenderer()(field, labels)


def batch(count: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(count)
    return torch.rand(count, 3, *SIZE, generator=generator), torch.randint(3, (count, *SIZE), generator=generator)


class TestExport:
    @compiler_warnings
    def test_runs_in_a_new_process(self, field: GaussianField, regions: RegionMap, tmp_path: Path) -> None:
        """A scene, a splat of any number of Gaussians, an encoder of any batch: traced with one, run with another."""
        torch.manual_seed(0)
        scene, splat, encoder = Scene(field, regions), Splat(), Encoder()
        parts = [field.means, field.cholesky, field.colors, field.region_ids, regions.labels]
        example = [t.detach() for t in parts if t is not None]
        fewer = [t[:7] for t in example[:4]] + example[4:]
        count, images = torch.export.Dim("N", min=0), torch.export.Dim("B", min=1)
        cases = [(scene, (), (), None), (splat, tuple(example), tuple(fewer), (({0: count},) * 4 + (None,),))]
        cases.append((encoder, batch(2), batch(3), ({0: images}, {0: images})))  # type: ignore[arg-type]
        expected = []
        for number, (module, example, arguments, shapes) in enumerate(cases):
            program = torch.export.export(module, example, dynamic_shapes=shapes)
            torch.export.save(program, tmp_path / f"{number}.pt2")
            expected.append((arguments, module(*arguments).detach()))
        torch.save(expected, tmp_path / "expected.pt")
        code = (
            "import sys, torch, kcgs.functional\n"  # registers the operator
            "for number, (arguments, expected) in enumerate(torch.load(f'{sys.argv[1]}/expected.pt')):\n"
            "    image = torch.export.load(f'{sys.argv[1]}/{number}.pt2').module()(*arguments)\n"
            "    torch.testing.assert_close(image, expected, rtol=1e-5, atol=1e-6)\n"
            "    assert number > 1 or torch.equal(image, expected)\n"  # without convolutions every bit is the same
            "    assert expected.abs().max() > 0.1 and not torch.equal(expected[0], expected[-1])\n"
        )
        subprocess.run([sys.executable, "-W", "ignore", "-c", code, str(tmp_path)], check=True)


class Splat(nn.Module):
    def forward(self, *tensors: Tensor) -> Tensor:
        return region_splat(*tensors)


class TestOperator:
    @compiler_warnings
    @pytest.mark.parametrize("kernel", ["cpu", "tiled", "reference"])
    def test_opcheck(self, field: GaussianField, regions: RegionMap, kernel: str) -> None:
        gaussians = [t.detach()[None].clone().requires_grad_() for t in (field.means, field.cholesky, field.colors)]
        settings = (field.region_ids[None], *table_and_size(regions)[0], *SIZE, 1e-4, kernel)
        torch.library.opcheck(torch.ops.kcgs.region_splat.default, (*gaussians, *settings))
        grad = torch.rand(1, 3, *SIZE, requires_grad=kernel == "reference")
        gaussians = gaussians if kernel == "reference" else [t.detach() for t in gaussians]
        torch.library.opcheck(torch.ops.kcgs.region_splat_backward.default, (grad, *gaussians, *settings, True))

    @pytest.mark.parametrize("size", [None, (40, 50)])
    def test_tensors_without_values(
        self, field: GaussianField, regions: RegionMap, size: tuple[int, int] | None
    ) -> None:
        """Shapes, forward and backward."""
        tensors = field.means, field.cholesky, field.colors, field.region_ids, regions.labels
        assert region_splat(*(t.to("meta") for t in tensors)).shape == (3, *SIZE)
        with FakeTensorMode() as mode:
            made = Scene(GaussianField.random(20, SIZE))
            made(size).sum().backward()
            assert made.field.means.grad is not None and made.field.means.grad.shape == (20, 2)
        mode.allow_non_fake_inputs = True
        with mode:
            assert Scene(field, regions)(size).shape == (3, *(size or SIZE))

    @pytest.mark.parametrize("kernel", ["cpu", "tiled"])
    def test_maps_that_share_labels_keep_their_gradients(self, field: GaussianField, kernel: str) -> None:
        """Two renders of the same tensors before the first backward: each has the gradient of its own contours."""
        labels = torch.zeros(SIZE, dtype=torch.long)
        labels[:, 16:] = 3
        maps = [RegionMap(labels, softness) for softness in (0.4, 4.0)]
        tensors = [t.detach()[None].clone() for t in (field.means, field.cholesky, field.colors)]
        tensors[2].requires_grad_()
        ids = field.region_ids[None]

        def render(regions: RegionMap) -> Tensor:
            return region_splat(*tensors, ids, regions, backend=kernel).square().sum()

        expected = [torch.autograd.grad(render(regions), tensors[2])[0] for regions in maps]
        for image, gradient in zip([render(regions) for regions in maps], expected, strict=True):
            assert torch.equal(torch.autograd.grad(image, tensors[2])[0], gradient)
        assert not torch.equal(*expected)

    @pytest.mark.parametrize("write", ["counted", "numpy", "data", "inference"])
    def test_labels_that_change(self, field: GaussianField, write: str) -> None:
        """A label map is read again at each call, whoever wrote to it; a RegionMap stays what it was made of."""
        gaussians = field.means.detach(), field.cholesky.detach(), field.colors.detach()
        array = np.zeros(SIZE, np.int64)
        array[:, 16:] = 3
        with torch.inference_mode(write == "inference"):
            labels = torch.from_numpy(array) if write in ("numpy", "data") else torch.from_numpy(array).clone()
            regions, ids = RegionMap(labels), torch.zeros_like(field.region_ids)
            before = region_splat(*gaussians, ids, labels)
            if write == "numpy":
                array[:] = array[:, ::-1].copy()
            elif write == "data":
                labels.data, ids.data = labels.flip(1), ids.clone()
            else:
                labels.copy_(labels.flip(1))
            after = region_splat(*gaussians, ids, labels)
            regions.labels.zero_()  # a copy
            assert torch.equal(region_splat(*gaussians, ids, regions), before) and int(regions.labels.max()) == 3
        assert torch.equal(after, region_splat(*gaussians, ids.clone(), labels.clone()))
        assert not torch.equal(after, before)

    @compiler_warnings
    def test_a_compiled_graph_has_the_tables_of_a_map(
        self, field: GaussianField, regions: RegionMap, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        compiled = torch.compile(RegionSplatRenderer(), backend="aot_eager")
        before = compiled(field, regions)
        monkeypatch.setattr("kcgs.maps.tiles._list_entries", None)
        assert torch.equal(compiled(field, regions), before)

    def test_a_pickle_has_no_tables_of_other_sizes(self, field: GaussianField, regions: RegionMap) -> None:
        scene = Scene(field, regions)
        fresh = len(pickle.dumps(scene))
        scene.render((4 * SIZE[0], 4 * SIZE[1]))
        assert len(pickle.dumps(scene)) == fresh
        assert torch.equal(pickle.loads(pickle.dumps(scene))(), scene())

    @pytest.mark.parametrize("kernel", ["cpu", "tiled", "reference"])
    def test_a_backward_is_of_its_forward(
        self, field: GaussianField, regions: RegionMap, kernel: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """What a graph renders once it plans once, and a map that is written to later does not change its gradients."""
        tensors = [t.detach().clone().requires_grad_() for t in (field.means, field.cholesky, field.colors)]
        labels, ids = regions.labels.clone(), field.region_ids.clone()
        image = region_splat(*tensors, ids, labels, backend=kernel)
        expected = torch.autograd.grad(image.square().sum(), tensors, retain_graph=True)
        labels.fill_(0)
        ids.fill_(3)
        monkeypatch.setattr("kcgs.functional.operator.prepare", None)
        for _ in range(2):
            result = torch.autograd.grad(image.square().sum(), tensors, retain_graph=True)
            assert all(torch.equal(a, b) for a, b in zip(result, expected, strict=True))
        assert image.grad_fn.execution is not None
        image.sum().backward()
        assert image.grad_fn.execution is None  # a loss that stays alive for its value holds none

    @pytest.mark.parametrize("name", ["region_ids", "regions"])
    @pytest.mark.parametrize("settings", [{"create_graph": True}, {"is_grads_batched": True}])
    def test_a_backward_that_plans_again_refuses_other_labels(
        self, field: GaussianField, regions: RegionMap, backend: str, name: str, settings: dict[str, bool]
    ) -> None:
        colors = field.colors.detach().clone().requires_grad_()
        maps = {"region_ids": field.region_ids.clone(), "regions": regions.labels.clone()}
        image = region_splat(field.means.detach(), field.cholesky.detach(), colors, **maps, backend=backend)
        grad = torch.ones(2, *image.shape) if "is_grads_batched" in settings else torch.ones_like(image)
        torch.autograd.grad(image, colors, grad, retain_graph=True, **settings)
        maps[name].fill_(3)
        with pytest.raises(RuntimeError, match=f"modified by an inplace operation: {name} of region_splat is at ver"):
            torch.autograd.grad(image, colors, grad, **settings)


class TestFunctional:
    def test_functional_call(self, field: GaussianField, regions: RegionMap, backend: str) -> None:
        """Other parameters through the same module, the field's own untouched."""
        module = Exposure(field, regions, backend)
        before = field.colors.detach().clone()
        swapped = {name: p.detach().clone() for name, p in module.named_parameters()}
        swapped["field.colors"] = (0.5 * swapped["field.colors"]).requires_grad_()
        result = torch.func.functional_call(module, swapped, (torch.full((1,), 2.0),))
        torch.testing.assert_close(result, module(torch.ones(1)), rtol=1e-5, atol=1e-6)
        result.sum().backward()
        assert swapped["field.colors"].grad is not None and swapped["field.colors"].grad.any()
        assert field.colors.grad is None and torch.equal(field.colors, before)

    @pytest.mark.parametrize("reentrant", [False, True])
    def test_checkpoint(self, field: GaussianField, regions: RegionMap, backend: str, reentrant: bool) -> None:
        """Evaluated again in the backward, the same gradients, bit for bit."""
        results = []
        for checkpointed in (False, True):
            leaves = [t.detach().clone().requires_grad_() for t in (field.means, field.cholesky, field.colors)]

            def render(*tensors: Tensor) -> Tensor:
                return region_splat(*tensors, field.region_ids, regions, backend=backend)

            image = checkpoint(render, *leaves, use_reentrant=reentrant) if checkpointed else render(*leaves)
            (image * image.detach().cos()).sum().backward()
            results.append([image.detach(), *(t.grad for t in leaves)])
        for result, expected in zip(*results, strict=True):
            assert expected is not None and expected.any() and torch.equal(result, expected)

    def test_jvp(self, field: GaussianField, regions: RegionMap) -> None:
        """The picture is linear in the colours: its derivative along a colour is the picture of that colour."""
        along = torch.rand(field.colors.shape, generator=torch.Generator().manual_seed(1))

        def render(colors: Tensor, backend: str = "reference") -> Tensor:
            return region_splat(field.means, field.cholesky, colors, field.region_ids, regions, backend=backend)

        _, derivative = torch.func.jvp(render, (field.colors.detach(),), (along,))
        torch.testing.assert_close(derivative, render(along), rtol=1e-5, atol=1e-6)
        with pytest.raises(RuntimeError, match="backend 'cpu' has first derivatives by backward only"):
            torch.func.jvp(lambda colors: render(colors, "cpu"), (field.colors.detach(),), (along,))

    def test_vmap_over_checks_of_values(self, field: GaussianField, regions: RegionMap) -> None:
        """vmap has no rule for assertions; what looks regions up goes with the renderer."""
        means = torch.stack([field.means.detach(), field.means.detach() + 3])

        def render(means: Tensor) -> Tensor:
            ids = lookup_regions(means, regions.labels)
            return region_splat(means, field.cholesky, field.colors, ids, regions)

        assert torch.equal(torch.func.vmap(render)(means), torch.stack([render(m) for m in means]))  # one map for all
        with pytest.raises(ValueError, match="means must be finite"):
            torch.func.vmap(render)(means / 0)

    def test_vmap_of_batches(self, backend: str) -> None:
        """Dimensions in any place, a map for each image of each batch, ids alone, levels in levels, none."""
        generator = torch.Generator().manual_seed(1)
        means = 12 * torch.rand(2, 3, 6, 2, generator=generator)
        others = torch.ones(2, 6, 3), torch.rand(2, 6, 3, generator=generator)
        ids, labels = (
            torch.randint(2, (3, 6), generator=generator),
            torch.randint(2, (2, 3, 9, 14), generator=generator),
        )

        def render(m: Tensor, regions: Tensor, i: Tensor) -> Tensor:
            return region_splat(m, *others, i.expand(2, 6), regions, backend=backend)

        def slope(m: Tensor, regions: Tensor, i: Tensor) -> Tensor:
            return torch.func.grad(lambda m: render(m, regions, i).square().sum())(m)

        for function in (render, slope):
            mapped = torch.func.vmap(function, in_dims=(1, 1, 0), out_dims=1)(means, labels, ids)
            singles = [function(means[:, k], labels[:, k], ids[k]) for k in range(3)]
            torch.testing.assert_close(mapped, torch.stack(singles, 1), rtol=1e-4, atol=1e-5)
        one = others[0][0], others[1][0], ids[0], labels[0, 0]
        levels = torch.func.vmap(torch.func.vmap(lambda m: region_splat(m, *one, backend=backend)))(means)
        torch.testing.assert_close(levels[1, 2], region_splat(means[1, 2], *one, backend=backend), rtol=1e-4, atol=1e-5)
        none = torch.func.vmap(
            lambda m: region_splat(m, m.new_ones(0, 3), m.new_ones(0, 1), size=(4, 5), backend=backend)
        )
        assert torch.equal(none(torch.ones(3, 0, 2)), torch.zeros(3, 1, 4, 5))

    def test_jacobian(self, backend: str) -> None:
        """By rows and by whole batches of gradients, and through a graph that is retained."""
        colors = torch.rand(3, 2, generator=torch.Generator().manual_seed(1), requires_grad=True)
        means, cholesky = torch.tensor([[1.0, 2.0], [4.0, 1.0], [3.0, 3.0]], requires_grad=True), torch.ones(3, 3)

        def render(m: Tensor, c: Tensor) -> Tensor:
            return region_splat(m, cholesky, c, size=(4, 5), backend=backend)

        image = render(means, colors)
        rows = torch.eye(image.numel()).view(-1, *image.shape)
        singles = [torch.autograd.grad(image, (means, colors), row, retain_graph=True) for row in rows]
        batched = torch.autograd.grad(image, (means, colors), rows, is_grads_batched=True)
        jacobians = torch.func.jacrev(render, (0, 1))(means.detach(), colors.detach())
        for k, (at_once, mapped) in enumerate(zip(batched, jacobians, strict=True)):
            expected = torch.stack([pair[k] for pair in singles])
            assert expected.any()
            torch.testing.assert_close(at_once, expected, rtol=1e-5, atol=1e-6)
            torch.testing.assert_close(mapped.flatten(0, 2), expected, rtol=1e-5, atol=1e-6)

    @pytest.mark.filterwarnings("ignore:There is a performance drop:UserWarning")  # as below
    @pytest.mark.parametrize("name", ["means", "cholesky", "colors"])
    def test_second_derivatives_forward_and_backward(self, field: GaussianField, regions: RegionMap, name: str) -> None:
        """In any order, the same Hessian; third derivatives are refused, and never zero."""
        gaussians = {n: getattr(field, n).detach()[:4].double() for n in ("means", "cholesky", "colors")}

        def loss(value: Tensor) -> Tensor:
            values = {**gaussians, name: value}
            return (
                region_splat(**values, region_ids=field.region_ids[:4], regions=regions, backend="reference")
                .exp()
                .sum()
            )

        func, place = torch.func, gaussians[name]
        direction = torch.rand(place.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
        leaf = place.clone().requires_grad_()
        (slope,) = torch.autograd.grad(loss(leaf), leaf, create_graph=True)
        (expected,) = torch.autograd.grad((slope * direction).sum(), leaf)
        assert expected.any()

        def along(value: Tensor) -> Tensor:
            return func.jvp(loss, (value,), (direction,))[1]

        results = [
            func.jvp(func.grad(loss), (place,), (direction,))[1],
            func.grad(along)(place),
            torch.tensordot(func.hessian(loss)(place), direction, 2),
            torch.autograd.functional.vhp(loss, place, direction)[1],
        ]
        for result in results:
            torch.testing.assert_close(result, expected)
        for third in (
            lambda: func.jvp(along, (place,), (direction,)),
            lambda: torch.autograd.functional.hvp(loss, place, direction),
            lambda: func.grad(lambda value: (func.grad(along)(value) * direction).sum())(place),
        ):
            with pytest.raises(RuntimeError, match="region_splat is differentiable (twice|forward once)"):
                third()

    @pytest.mark.filterwarnings(
        "ignore:There is a performance drop:UserWarning"
    )  # of vmap, second derivatives one by one
    @pytest.mark.parametrize("kernel", ["cpu", "tiled", "reference"])
    def test_levels_of_gradients(self, field: GaussianField, regions: RegionMap, kernel: str) -> None:
        """A gradient of a gradient is not zero: it is right, or refused by name."""
        means = field.means.detach()[:4]
        others = field.cholesky.detach()[:4], field.colors.detach()[:4].requires_grad_(), field.region_ids[:4]

        def loss(m: Tensor) -> Tensor:
            return region_splat(m, *others, regions, backend=kernel).square().sum()

        inner = torch.func.grad(loss)
        slopes = [lambda m: torch.func.grad(lambda m: inner(m).square().sum())(m), torch.func.jacrev(inner)]
        # the inner loop of a training: its gradient, differentiated by what the loop does not know of
        slopes.append(lambda m: torch.autograd.grad(inner(m).square().sum(), others[1])[0])

        def twice(m: Tensor) -> Tensor:
            (first,) = torch.autograd.grad(loss(m), others[1], create_graph=True)
            return torch.autograd.grad(first.square().sum(), others[1])[0]

        if kernel != "reference":
            for slope in (*slopes, twice):
                with pytest.raises(RuntimeError, match=f"backend '{kernel}' has first derivatives by backward only"):
                    slope(means)
            return
        leaf = means.clone().requires_grad_()
        (first,) = torch.autograd.grad(loss(leaf), leaf, create_graph=True)
        expected = [torch.autograd.grad(first.square().sum(), t, retain_graph=True)[0] for t in (leaf, others[1])]
        rows = [torch.autograd.grad(value, leaf, retain_graph=True)[0] for value in first.flatten()]
        expected.insert(1, torch.stack(rows).view(4, 2, 4, 2))
        for slope, reference in zip(slopes, expected, strict=True):
            assert reference.any()
            torch.testing.assert_close(slope(means), reference, rtol=1e-4, atol=1e-4)


class TestState:
    @pytest.mark.parametrize("clone", [copy.deepcopy, lambda m: pickle.loads(pickle.dumps(m))])
    def test_copies_render_the_same(self, field: GaussianField, regions: RegionMap, clone: Any) -> None:
        """The label map goes along."""
        module = Exposure(field, regions)
        other = clone(module)
        result, expected = (image_and_gradients(m, torch.ones(1)) for m in (other, module))
        assert all(torch.equal(a, b) for a, b in zip(result, expected, strict=True))
        with torch.no_grad():
            other.field.colors.zero_()
        assert torch.equal(module(torch.ones(1)).detach(), expected[0])
