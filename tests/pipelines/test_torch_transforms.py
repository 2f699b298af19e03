"""The renderer among torch's own machinery: compile, export, transforms, checkpoints, pickle."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
import torch._dynamo.testing
from torch import Tensor, nn
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


def leaves_of(field: GaussianField) -> list[Tensor]:
    return [t.detach().clone().requires_grad_() for t in (field.means, field.cholesky, field.colors)]


def batch(images: int, count: int) -> tuple[list[Tensor], Tensor, Tensor]:
    """Make Gaussians, their region ids, and a label map for each image."""
    labels = (torch.arange(SIZE[1]) > 5 + torch.arange(images)[:, None, None]).long().expand(-1, *SIZE)
    field = GaussianField.stack([GaussianField.random(count, SIZE, seed=k) for k in range(images)])
    return leaves_of(field), lookup_regions(field.means, labels), labels


class TestCompile:
    @pytest.fixture(autouse=True)
    def fresh(self) -> Iterator[None]:
        torch._dynamo.reset()
        yield
        torch._dynamo.reset()

    @compiler_warnings
    def test_training_steps_with_kornia_in_one_graph(
        self, field: GaussianField, regions: RegionMap, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Gradients are those of eager mode, also after a step: nothing of the field is baked in.

        Compilers keep the operator: they do not decompose it as `torch.onnx.export` does.
        """
        import kornia

        chain = nn.Sequential(RegionSplatRenderer(keepdim=False), kornia.filters.GaussianBlur2d((3, 3), (1.0, 1.0)))
        scene = Scene(field, regions)

        def loss() -> Tensor:
            return kornia.losses.charbonnier_loss(chain(scene), torch.zeros(1, 3, *SIZE), reduction="mean")

        monkeypatch.setitem(torch._decomp.decomposition_table, torch.ops.kcgs.region_splat.default, None)
        compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
        for _ in range(2):
            gradients = (torch.autograd.grad(function(), list(scene.parameters())) for function in (compiled, loss))
            for gradient, eager in zip(*gradients, strict=True):
                torch.testing.assert_close(gradient, eager, rtol=1e-5, atol=1e-7)
            with torch.no_grad():
                field.means.add_(1.0)

    @compiler_warnings
    def test_one_graph_for_all_sizes(self) -> None:
        """Forward and backward, without a map and with one."""
        counter = torch._dynamo.testing.CompileCounterWithBackend("inductor")
        compiled = torch.compile(region_splat, backend=counter, fullgraph=True, dynamic=True)
        counts = []
        for count, size in ((20, SIZE), (12, (31, 20)), (31, (16, 50))):
            labels = (torch.arange(size[1]) > 9).long().expand(size).contiguous()
            field = GaussianField.random(count, size, regions=labels, seed=count)
            leaves = leaves_of(field)
            for regions, options in (((), {"size": size}), ((field.region_ids, labels), {})):
                image, eager = (splat(*leaves, *regions, **options) for splat in (compiled, region_splat))
                assert torch.equal(image, eager) and eager.abs().max() > 0.1
                gradients = (torch.autograd.grad(t.square().sum(), leaves) for t in (image, eager))
                assert all(torch.equal(a, b) for a, b in zip(*gradients, strict=True))
            counts.append(counter.frame_count)
        assert counts[0] == counts[2]

    @compiler_warnings
    def test_batches_of_any_number_with_maps_of_their_own(self) -> None:
        compiled = torch.compile(region_splat, backend="aot_eager", fullgraph=True, dynamic=True)
        for images, count in ((2, 3), (3, 7)):
            leaves, ids, labels = batch(images, count)
            regions = RegionMap(labels, 0.8)
            image, eager = (splat(*leaves, ids, regions) for splat in (compiled, region_splat))
            assert image.shape == (images, 3, *SIZE) and torch.equal(image, eager)
            gradients = (torch.autograd.grad(t.square().sum(), leaves) for t in (image, eager))
            assert all(torch.equal(a, b) for a, b in zip(*gradients, strict=True))

    @compiler_warnings
    def test_a_scene_at_any_size(self, field: GaussianField, regions: RegionMap) -> None:
        scene, counts = Scene(field, regions), []
        counter = torch._dynamo.testing.CompileCounterWithBackend("aot_eager")
        compiled = torch.compile(scene, backend=counter, fullgraph=True)
        for size in (None, (48, 72), (30, 20), (31, 50)):  # its own size, a first other one, and any
            image, eager = (module(size=size) for module in (compiled, scene))
            torch.testing.assert_close(image, eager, rtol=1e-5, atol=1e-6)
            gradients = (torch.autograd.grad(t.sum(), list(scene.parameters())) for t in (image, eager))
            for gradient, expected in zip(*gradients, strict=True):
                torch.testing.assert_close(gradient, expected, rtol=1e-4, atol=1e-5)
            counts.append(counter.frame_count)
        assert counts[3] == counts[2] <= 3

    @compiler_warnings
    def test_scenes_of_any_number_of_gaussians(self) -> None:
        """torch takes shapes of a module's tensors for constants unless told otherwise: then one graph serves all.

        But a map of one region has a graph of its own, as have tensors whose sizes are equal by chance.
        """
        counter = torch._dynamo.testing.CompileCounterWithBackend("aot_eager")
        compiled, counts = torch.compile(RegionSplatRenderer(), backend=counter, fullgraph=True, dynamic=True), []
        options = {"force_parameter_static_shapes": False, "force_nn_module_property_static_shapes": False}
        for count, softness in ((20, 1.1), (12, 1.6), (30, 1.1)):
            regions = RegionMap((torch.arange(SIZE[1]) > count).long().expand(SIZE), softness)
            scene = Scene(GaussianField.random(count, SIZE, regions=regions, seed=0), regions)
            with torch._dynamo.config.patch(options):
                assert torch.equal(compiled(scene), scene())
            counts.append(counter.frame_count)
        assert counts[0] == counts[2]


class Splat(nn.Module):
    def forward(self, *tensors: Tensor) -> Tensor:
        return region_splat(*tensors)


@compiler_warnings
def test_exported_programs(field: GaussianField, regions: RegionMap, tmp_path: Path) -> None:
    """A scene, and a splat of any number of Gaussians and images: traced with one, saved, run with another."""
    images, count = torch.export.Dim("B", min=1), torch.export.Dim("N", min=0)
    shapes = (({0: images, 1: count},) * 4 + ({0: images},),)
    examples = ([t.detach() for t in (*leaves, ids, labels)] for leaves, ids, labels in (batch(2, 20), batch(3, 7)))
    for module, example, arguments, dims in ((Scene(field, regions), (), (), None), (Splat(), *examples, shapes)):
        program = torch.export.export(module, tuple(example), dynamic_shapes=dims)
        torch.export.save(program, tmp_path / "program.pt2")
        image, expected = (m(*arguments) for m in (torch.export.load(tmp_path / "program.pt2").module(), module))
        assert torch.equal(image, expected)
        assert expected.abs().max() > 0.1 and not torch.equal(expected[0], expected[-1])


class TestOperator:
    @compiler_warnings
    @pytest.mark.parametrize("kernel", ["cpu", "reference"])
    def test_opcheck(self, field: GaussianField, regions: RegionMap, kernel: str) -> None:
        gaussians = [t.detach()[None].clone().requires_grad_() for t in (field.means, field.cholesky, field.colors)]
        settings = (field.region_ids[None], *table_and_size(regions)[0], *SIZE, 1e-4, kernel)
        torch.library.opcheck(torch.ops.kcgs.region_splat.default, (*gaussians, *settings))
        grad = torch.rand(1, 3, *SIZE, requires_grad=kernel == "reference")
        gaussians = gaussians if kernel == "reference" else [t.detach() for t in gaussians]
        torch.library.opcheck(torch.ops.kcgs.region_splat_backward.default, (grad, *gaussians, *settings, True))

    def test_maps_that_share_labels_keep_their_gradients(self, field: GaussianField) -> None:
        """Two renders of the same tensors before the first backward: each has the gradient of its own contours."""
        labels = torch.zeros(SIZE, dtype=torch.long)
        labels[:, 16:] = 3
        maps = [RegionMap(labels, softness) for softness in (0.4, 4.0)]
        tensors = [t.detach()[None].clone() for t in (field.means, field.cholesky, field.colors)]
        tensors[2].requires_grad_()

        def render(regions: RegionMap) -> Tensor:
            return region_splat(*tensors, field.region_ids[None], regions).square().sum()

        expected = [torch.autograd.grad(render(regions), tensors[2])[0] for regions in maps]
        for image, gradient in zip([render(regions) for regions in maps], expected, strict=True):
            assert torch.equal(torch.autograd.grad(image, tensors[2])[0], gradient)
        assert not torch.equal(*expected)

    @pytest.mark.parametrize("is_inference", [False, True])
    def test_labels_that_change(self, field: GaussianField, is_inference: bool) -> None:
        """A label map is read again at each call, whoever wrote to it; a RegionMap stays what it was made of."""
        gaussians = field.means.detach(), field.cholesky.detach(), field.colors.detach()
        array = np.zeros(SIZE, np.int64)
        array[:, 16:] = 3
        with torch.inference_mode(is_inference):
            labels = torch.from_numpy(array)
            regions, ids = RegionMap(labels), torch.zeros_like(field.region_ids)
            before = region_splat(*gaussians, ids, labels)
            array[:] = array[:, ::-1].copy()
            after = region_splat(*gaussians, ids, labels)
            regions.labels.zero_()  # a copy
            assert torch.equal(region_splat(*gaussians, ids, regions), before) and int(regions.labels.max()) == 3
        assert torch.equal(after, region_splat(*gaussians, ids.clone(), labels.clone()))
        assert not torch.equal(after, before)

    def test_a_pickle_has_no_tables_of_other_sizes(self, field: GaussianField, regions: RegionMap) -> None:
        scene = Scene(field, regions)
        fresh = len(pickle.dumps(scene))
        scene.render((4 * SIZE[0], 4 * SIZE[1]))
        assert len(pickle.dumps(scene)) == fresh

    @pytest.mark.parametrize("kernel", ["cpu", "tiled"])
    def test_a_backward_is_of_its_forward(
        self, field: GaussianField, regions: RegionMap, kernel: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """What a graph renders once it plans once, and a map that is written to later does not change its gradients."""
        tensors, labels, ids = leaves_of(field), regions.labels.clone(), field.region_ids.clone()
        image = region_splat(*tensors, ids, labels, backend=kernel)
        expected = torch.autograd.grad(image.square().sum(), tensors, retain_graph=True)
        labels.fill_(0)
        ids.fill_(3)
        monkeypatch.setattr("kcgs.functional.operator.prepare", None)
        result = torch.autograd.grad(image.square().sum(), tensors, retain_graph=True)
        assert all(torch.equal(a, b) for a, b in zip(result, expected, strict=True))
        assert image.grad_fn.execution is not None
        image.sum().backward()
        assert image.grad_fn.execution is None  # a loss that stays alive for its value holds none

    @pytest.mark.parametrize(("name", "option"), [("region_ids", "create_graph"), ("regions", "is_grads_batched")])
    def test_a_backward_that_plans_again_refuses_other_labels(
        self, field: GaussianField, regions: RegionMap, name: str, option: str
    ) -> None:
        colors = field.colors.detach().clone().requires_grad_()
        maps = {"region_ids": field.region_ids.clone(), "regions": regions.labels.clone()}
        image = region_splat(field.means.detach(), field.cholesky.detach(), colors, **maps)
        grad = torch.ones(2, *image.shape) if option == "is_grads_batched" else torch.ones_like(image)
        torch.autograd.grad(image, colors, grad, retain_graph=True, **{option: True})
        maps[name].fill_(3)
        with pytest.raises(RuntimeError, match=f"modified by an inplace operation: {name} of region_splat is at ver"):
            torch.autograd.grad(image, colors, grad, **{option: True})


class TestFunctional:
    @pytest.mark.parametrize("reentrant", [False, True])
    def test_checkpoint(self, field: GaussianField, regions: RegionMap, reentrant: bool) -> None:
        """Evaluated again in the backward, the same gradients, bit for bit."""
        results = []
        for checkpointed in (False, True):
            leaves = leaves_of(field)

            def render(*tensors: Tensor) -> Tensor:
                return region_splat(*tensors, field.region_ids, regions)

            image = checkpoint(render, *leaves, use_reentrant=reentrant) if checkpointed else render(*leaves)
            (image * image.detach().cos()).sum().backward()
            results.append([image.detach(), *(t.grad for t in leaves)])
        for result, expected in zip(*results, strict=True):
            assert expected is not None and expected.any() and torch.equal(result, expected)

    def test_jvp(self, field: GaussianField, regions: RegionMap) -> None:
        """The image is linear in the colours: its derivative along a colour is the image of that colour."""
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

    def test_vmap_of_batches(self) -> None:
        """Dimensions in any place, a map for each image of each batch, ids alone, levels in levels, none."""
        generator = torch.Generator().manual_seed(1)
        means = 12 * torch.rand(2, 3, 6, 2, generator=generator)
        others = torch.ones(2, 6, 3), torch.rand(2, 6, 3, generator=generator)
        ids = torch.randint(2, (3, 6), generator=generator)
        labels = torch.randint(2, (2, 3, 9, 14), generator=generator)

        def render(m: Tensor, regions: Tensor, i: Tensor) -> Tensor:
            return region_splat(m, *others, i.expand(2, 6), regions)

        def slope(m: Tensor, regions: Tensor, i: Tensor) -> Tensor:
            return torch.func.grad(lambda m: render(m, regions, i).square().sum())(m)

        for function in (render, slope):
            mapped = torch.func.vmap(function, in_dims=(1, 1, 0), out_dims=1)(means, labels, ids)
            singles = [function(means[:, k], labels[:, k], ids[k]) for k in range(3)]
            torch.testing.assert_close(mapped, torch.stack(singles, 1), rtol=1e-4, atol=1e-5)
        one = others[0][0], others[1][0], ids[0], labels[0, 0]
        levels = torch.func.vmap(torch.func.vmap(lambda m: region_splat(m, *one)))(means)
        torch.testing.assert_close(levels[1, 2], region_splat(means[1, 2], *one), rtol=1e-4, atol=1e-5)
        none = torch.func.vmap(lambda m: region_splat(m, m.new_ones(0, 3), m.new_ones(0, 1), size=(4, 5)))
        assert torch.equal(none(torch.ones(3, 0, 2)), torch.zeros(3, 1, 4, 5))

    def test_jacobian(self) -> None:
        """By rows and by whole batches of gradients, and through a graph that is retained."""
        colors = torch.rand(3, 2, generator=torch.Generator().manual_seed(1), requires_grad=True)
        means, cholesky = torch.tensor([[1.0, 2.0], [4.0, 1.0], [3.0, 3.0]], requires_grad=True), torch.ones(3, 3)

        def render(m: Tensor, c: Tensor) -> Tensor:
            return region_splat(m, cholesky, c, size=(4, 5))

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

    @pytest.mark.filterwarnings("ignore:There is a performance drop:UserWarning")  # of vmap, one by one
    @pytest.mark.parametrize("fixed", [0, 2])
    def test_second_derivatives_forward_and_backward(
        self, field: GaussianField, regions: RegionMap, fixed: int
    ) -> None:
        """In any order the same Hessian, also of colours alone; third derivatives are refused, and never zero."""
        tables = [t.detach()[:4].double() for t in (field.means, field.cholesky, field.colors)]

        def loss(values: Tensor) -> Tensor:
            gaussians = *tables[:fixed], *values.split([2, 3, 3][fixed:], -1)
            image = region_splat(*gaussians, field.region_ids[:4], regions, backend="reference")
            return image.exp().sum()

        func, place = torch.func, torch.cat(tables[fixed:], -1)
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
            func.grad(lambda values: (func.grad(loss)(values) * direction).sum())(place),
            torch.tensordot(func.jacrev(func.grad(loss))(place), direction, 2),
            # the inner loop of a training: its gradient, differentiated by what the loop does not know of
            torch.autograd.grad((func.grad(lambda values: loss(leaf + values))(0 * place) * direction).sum(), leaf)[0],
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

    @pytest.mark.filterwarnings("ignore:There is a performance drop:UserWarning")
    def test_second_derivatives_of_other_backends_are_refused(self, field: GaussianField, regions: RegionMap) -> None:
        leaf = field.colors.detach().requires_grad_()

        def loss(colors: Tensor) -> Tensor:
            return region_splat(field.means, field.cholesky, colors, field.region_ids, regions).square().sum()

        inner = torch.func.grad(loss)
        (slope,) = torch.autograd.grad(loss(leaf), leaf, create_graph=True)
        for second in (
            lambda: torch.func.grad(lambda colors: inner(colors).square().sum())(leaf.detach()),
            lambda: torch.func.jacrev(inner)(leaf.detach()),
            lambda: torch.autograd.grad(slope.square().sum(), leaf),
        ):
            with pytest.raises(RuntimeError, match="backend 'auto' has first derivatives by backward only"):
                second()
