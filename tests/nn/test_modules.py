"""GaussianField and RegionSplatRenderer as torch modules among others."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor, nn

from kcgs import GaussianField, RegionMap, RegionSplatRenderer, Scene
from kcgs.functional import edge_band, region_splat
from tests.tester import BaseTester

SIZE = (24, 36)


@pytest.fixture
def labels() -> Tensor:
    labels = torch.zeros(SIZE, dtype=torch.long)
    labels[6:18, 10:30] = 4
    return labels


@pytest.fixture
def field(labels: Tensor) -> GaussianField:
    return GaussianField.random(60, SIZE, regions=labels, seed=0)


def whole(dtype: torch.dtype) -> torch.dtype:
    """Give the dtype of a field, which holds no half precision."""
    return torch.promote_types(dtype, torch.float32)


class TestGaussianField(BaseTester):
    def test_smoke(self, device: torch.device, dtype: torch.dtype) -> None:
        field = GaussianField.random(60, SIZE, seed=0, dtype=whole(dtype)).to(device)
        assert field.means.device.type == device.type and field.colors.dtype == whole(dtype)
        assert all(p.isfinite().all() and p.any() for p in field.parameters())

    @pytest.mark.parametrize("lead", [(), (3,)])
    @pytest.mark.parametrize(("count", "channels"), [(0, 3), (7, 5)])
    def test_cardinality(
        self, device: torch.device, dtype: torch.dtype, lead: tuple[int, ...], count: int, channels: int
    ) -> None:
        tensors = [torch.ones(*lead, count, n, device=device, dtype=dtype) for n in (2, 3, channels)]
        field = GaussianField(*tensors, opacities=tensors[0][..., 0], size=SIZE)
        assert field.num_gaussians == count and field.merged_colors().shape == (*lead, count, channels)
        assert field.means.dtype == whole(dtype) and field.size == SIZE
        labels = torch.zeros(*lead, *SIZE, device=device, dtype=torch.long)
        assert field.assign_regions(labels).region_ids.shape == (*lead, count)
        one = field[0] if lead else field
        assert one.means.shape == (count, 2) and one.subset(torch.arange(count)).num_gaussians == count

    def test_gradcheck(self, device: torch.device, labels: Tensor) -> None:
        """Tensors of a graph stay in it: gradients pass a field, its opacities too."""
        field = GaussianField.random(4, SIZE, regions=labels, seed=0).to(device)
        render = RegionSplatRenderer(0.0, backend="reference")

        def draw(*tensors: Tensor) -> Tensor:
            means, cholesky, colors, opacities = (1 * t for t in tensors)
            return render(
                GaussianField(means, cholesky, colors, field.region_ids, opacities, size=SIZE), labels.to(device)
            )

        self.gradcheck(draw, (field.means, field.cholesky, field.colors, torch.linspace(0.2, 1, 4, device=device)))

    def test_dynamo(self, device: torch.device, dtype: torch.dtype, labels: Tensor) -> None:
        """Made, assigned and rendered in one graph, as after a network."""
        labels = labels.to(device)
        raw = torch.rand(2, 9, 8, generator=torch.Generator().manual_seed(0)).to(device, dtype).requires_grad_()

        def draw(raw: Tensor) -> Tensor:
            field = GaussianField(24 * raw[..., :2], 1 + raw[..., 2:5], raw[..., 5:], size=SIZE).assign_regions(labels)
            return RegionSplatRenderer()(field, labels)

        self.assert_compiles(draw, raw, leaves=[raw], backend="aot_eager")

    def test_module(self, field: GaussianField, labels: Tensor) -> None:
        """A parameter is used as it is, a tensor of a graph becomes a buffer, any other is copied to a parameter."""
        assert {name for name, _ in field.named_parameters()} == {"means", "cholesky", "colors"}
        means, colors = field.means.detach().clone(), (1 * field.colors).detach().requires_grad_()
        other = GaussianField(means, field.cholesky, colors, field.region_ids, size=SIZE)
        assert other.cholesky is field.cholesky and other.colors is colors and other.means is not means
        assert {name for name, _ in other.named_buffers()} == {"colors", "region_ids"}
        other.double()
        assert other.region_ids.dtype == torch.int64
        assert RegionSplatRenderer()(other, labels).dtype == torch.float64 and means.dtype == torch.float32

    def test_random_is_seeded(self) -> None:
        a, b = (GaussianField.random(10, SIZE, seed=3) for _ in range(2))
        assert torch.equal(a.means, b.means) and torch.equal(a.colors, b.colors)
        assert not torch.equal(a.means, GaussianField.random(10, SIZE, seed=4).means)

    def test_half_is_refused_aloud(self, field: GaussianField) -> None:
        before = field.means.detach().clone()
        with pytest.warns(UserWarning, match="stays in float32"):
            field.bfloat16()
        assert field.means.dtype == field.colors.dtype == torch.float32
        assert torch.equal(field.means, before)

    def test_subset(self, field: GaussianField, labels: Tensor) -> None:
        inside = field.region_ids == 4
        part, rest = field.subset(inside), field.subset((~inside).nonzero().flatten())
        assert part.num_gaussians + rest.num_gaussians == 60 and 0 < part.num_gaussians < 60
        total = RegionSplatRenderer()(part, labels) + RegionSplatRenderer()(rest, labels)
        torch.testing.assert_close(total, RegionSplatRenderer()(field, labels))

    @pytest.mark.parametrize("confined", [False, True])
    def test_stack_and_back(self, field: GaussianField, confined: bool) -> None:
        """A batch has what each field has, as leaves of its own."""
        last = "region_ids" if confined else "opacities"
        if not confined:
            field = GaussianField(field.means, field.cholesky, field.colors, opacities=torch.rand(60), size=SIZE)
        fields = [field, field.shift(1.0, 0.0).subset(torch.arange(60))]
        batch = GaussianField.stack(fields)
        assert all(isinstance(p, nn.Parameter) and len(p) == 2 for p in batch.parameters())
        for one, again in zip(fields, batch.unbind(), strict=True):
            assert one.size == again.size and one.state_dict().keys() == again.state_dict().keys()
            assert all(torch.equal(getattr(one, n), getattr(again, n)) for n in ("means", "cholesky", "colors", last))

    @pytest.mark.parametrize(
        ("other", "error", "words"),
        [
            ([], ValueError, "fields must hold at least one; got none"),
            ([nn.Linear(2, 3)], TypeError, "fields must be GaussianFields; got Linear"),
            ([GaussianField.random(60, SIZE), GaussianField.random(59, SIZE)], ValueError, "alike.* 60 .*got .* 59 "),
            ([GaussianField.stack([GaussianField.random(9, SIZE)])], ValueError, "one image each.*got one with 1 x 9"),
        ],
    )  # fmt: skip
    def test_exception_stack(self, other: list[GaussianField], error: type[Exception], words: str) -> None:
        with pytest.raises(error, match=words):
            GaussianField.stack(other)
        with pytest.raises(ValueError, match="an index needs a batched field"):
            GaussianField.random(9, SIZE).unbind()

    def test_feature(self, field: GaussianField, labels: Tensor) -> None:
        """Opacities are merged into colours."""
        alpha = torch.rand(60)
        with_alpha = GaussianField(field.means, field.cholesky, field.colors, field.region_ids, alpha, size=SIZE)
        merged = GaussianField(
            field.means, field.cholesky, field.colors.detach() * alpha[:, None], field.region_ids, size=SIZE
        )
        image = RegionSplatRenderer()(with_alpha, labels)
        torch.testing.assert_close(image, RegionSplatRenderer()(merged, labels))

    @pytest.mark.parametrize(
        ("change", "error", "words"),
        [
            ({"means": torch.zeros(3, 2)}, ValueError, r"cholesky must have shape \(3, 3\); got \(2, 3\)"),
            ({"cholesky": torch.zeros(2, 3)}, ValueError, "l11 > 0"),
            ({"colors": torch.zeros(2)}, ValueError, "colors must have 2 or 3 dimensions"),
            ({"region_ids": torch.tensor([0, -3])}, ValueError, "non-negative; got -3"),
            ({"region_ids": torch.tensor([0.5, 1.0])}, TypeError, "integer dtype"),
            ({"opacities": torch.ones(3)}, ValueError, r"opacities must have shape \(2,\); got \(3,\)"),
            ({"size": (4, 0)}, ValueError, "size must be at least 1 x 1"),
            ({"means": torch.full((2, 2), math.inf)}, ValueError, "means must be finite"),
        ],
    )
    def test_exception(self, change: dict[str, object], error: type[Exception], words: str) -> None:
        good = {"means": torch.zeros(2, 2), "cholesky": torch.ones(2, 3), "colors": torch.zeros(2, 3), "size": SIZE}
        with pytest.raises(error, match=words):
            GaussianField(**{**good, **change})

    @pytest.mark.parametrize("mask", [torch.ones(5, dtype=torch.bool), torch.tensor([60]), torch.tensor([-1])])
    def test_exception_subset(self, field: GaussianField, mask: Tensor) -> None:
        with pytest.raises(ValueError, match="mask must"):
            field.subset(mask)


WITHOUT = {
    "test_smoke": "test_feature computes with it on each device",
    "test_module": "TestRegionSplat compares it with its twin",
    "test_dynamo": "compiled in tests/pipelines/test_torch_transforms.py",
}


class TestRegionSplatRenderer(BaseTester, without=WITHOUT):
    def scene(self, device: torch.device, dtype: torch.dtype, labels: Tensor, count: int = 60) -> Scene:
        field = GaussianField.random(count, SIZE, regions=labels, seed=0, dtype=whole(dtype))
        return Scene(field, labels).to(device)

    @pytest.mark.parametrize(
        ("lead", "keepdim", "size"), [((), True, None), ((), False, (10, 50)), ((2,), False, None)]
    )
    def test_cardinality(
        self, device: torch.device, lead: tuple[int, ...], keepdim: bool, size: tuple[int, int] | None
    ) -> None:
        tensors = [torch.ones(*lead, 5, n, device=device) for n in (2, 3, 4)]
        image = RegionSplatRenderer(keepdim=keepdim)(GaussianField(*tensors, size=SIZE), size=size)
        assert image.shape == ((*lead, 4) if keepdim or lead else (1, 4)) + (size or SIZE) and image.any()

    def test_gradcheck(self, device: torch.device, labels: Tensor) -> None:
        """At another size, through a soft map."""
        scene = self.scene(device, torch.float32, labels, 4)
        regions = RegionMap(labels.to(device), 0.8)

        def draw(*tensors: Tensor) -> Tensor:
            field = GaussianField(*(1 * t for t in tensors), scene.field.region_ids, size=SIZE)
            return RegionSplatRenderer(0.0, backend="tiled")(field, regions, (12, 30))

        self.gradcheck(draw, (scene.field.means, scene.field.cholesky, scene.field.colors))

    def test_feature(self, device: torch.device, dtype: torch.dtype, labels: Tensor) -> None:
        """Each block of 3 x 3 pixels has the centre of its middle where a pixel of the small image has it."""
        scene, render = self.scene(device, dtype, labels), RegionSplatRenderer(0.0)
        inside = ~edge_band(labels, width=4).to(device)
        image = render(scene, size=(72, 108))[:, 1::3, 1::3]
        self.assert_close(image[:, inside], render(scene)[:, inside], rtol=1e-4, atol=1e-5)
        scene = Scene(scene.field.subset(torch.arange(scene.num_gaussians)))
        scene.field.region_ids = None
        self.assert_close(render(scene, size=(24, 108))[:, :, 1::3], render(scene), rtol=1e-4, atol=1e-5)

    def test_clamp(self, field: GaussianField, labels: Tensor) -> None:
        with torch.no_grad():
            field.colors.mul_(20).sub_(3)
        free, clamped = RegionSplatRenderer()(field, labels), RegionSplatRenderer(clamp=True)(field, labels)
        assert free.min() < 0 and free.max() > 1
        assert torch.equal(clamped, free.clamp(0, 1))

    @pytest.mark.parametrize(("size", "softness"), [((1, 1), None), ((30, 11), 0.8), ((23, 35), None)])
    def test_a_smaller_image_is_the_area_mean(
        self, field: GaussianField, labels: Tensor, size: tuple[int, int], softness: float | None
    ) -> None:
        """Means over shares, fractions included: of pixels that are repeated until shares are whole."""
        if softness is None:
            field.region_ids = None
        scene = Scene(field, None if softness is None else RegionMap(labels, softness))
        rendered = (max(SIZE[0], size[0]), max(SIZE[1], size[1]))
        image = RegionSplatRenderer()(scene, size=rendered).double()
        for dim, side in ((1, size[0]), (2, size[1])):
            parts = image.repeat_interleave(side, dim).unflatten(dim, (side, -1))
            image = parts.mean(dim + 1)
        torch.testing.assert_close(scene(size), image.float(), rtol=1e-5, atol=1e-6)

    def test_exception(self, field: GaussianField, labels: Tensor) -> None:
        render = RegionSplatRenderer()
        with pytest.raises(ValueError, match=r"regions must have the size \(24, 36\)"):
            render(field, labels[:5])
        with pytest.raises(ValueError, match="field must have region_ids"):
            render(GaussianField.random(3, SIZE), labels)
        for confined in (field, Scene(field)):
            with pytest.raises(ValueError, match="regions must be given for a field that is confined to regions"):
                render(confined)
        with pytest.raises(TypeError, match="field must be a GaussianField or a Scene; got Tensor"):
            render(labels)
        with pytest.raises(ValueError, match="cutoff must be in"):
            RegionSplatRenderer(cutoff=2.0)
        with pytest.raises(ValueError, match="backend must be one of auto, reference, tiled, cpu, cuda; got 'gpu'"):
            RegionSplatRenderer(backend="gpu")

    def test_a_map_that_lacks_ids(self, field: GaussianField, labels: Tensor) -> None:
        other = torch.where(labels == 4, 99, labels)
        count = int((field.region_ids == 4).sum())
        words = f"^{count} of {field.num_gaussians} Gaussians paint nothing: .* such as 4;"
        with pytest.warns(UserWarning, match=words):
            image = Scene(field, other).render()
        assert (image[:, labels == 4] == 0).all() and (image[:, labels != 4] > 0).any()
        assert RegionSplatRenderer()(GaussianField.random(0, SIZE, regions=labels), labels).eq(0).all()


def test_tables_made_in_inference_mode_serve_a_later_backward(field: GaussianField, labels: Tensor) -> None:
    render, regions = RegionSplatRenderer(), RegionMap(labels, 0.7)
    with torch.inference_mode():
        image = render(field, regions)
    assert not image.requires_grad and torch.equal(image, render(field, regions))
    render(field, regions).sum().backward()
    assert field.means.grad is not None


class TestBatch:
    """Images whose maps have other regions, and other numbers of them."""

    IDS = ((0, 4), (7,), (2, 9, 5))

    @pytest.fixture
    def maps(self) -> Tensor:
        maps = torch.zeros(3, *SIZE, dtype=torch.long)
        for labels, ids in zip(maps, self.IDS, strict=True):
            labels[:] = torch.tensor(ids)[torch.arange(SIZE[1]) * len(ids) // SIZE[1]]
        return maps

    @pytest.mark.parametrize("form", ["tensor", "pairs", "resized"])
    def test_is_its_images(self, maps: Tensor, backend: str, form: str) -> None:
        softness = {"pairs": {(0, 4): 1.0, (9, 5): 0.5}, "resized": [0.7, 0.0, {(2, 9): 1.3}]}
        regions = maps if form == "tensor" else RegionMap(maps, softness[form])
        size = (40, 50) if form == "resized" else None
        parts = [GaussianField.random(30, SIZE, regions=labels, seed=k) for k, labels in enumerate(maps)]
        batch = GaussianField.stack(parts).assign_regions(regions)
        assert [tuple(row.unique().tolist()) for row in batch.region_ids] == [tuple(sorted(ids)) for ids in self.IDS]
        render = RegionSplatRenderer(backend=backend)
        images = render(batch, regions, size)
        images.square().sum().backward()
        singles = regions if isinstance(regions, Tensor) else [regions[k] for k in range(len(maps))]
        for k, (part, one) in enumerate(zip(parts, singles, strict=True)):
            image = render(part, one, size)
            image.square().sum().backward()
            torch.testing.assert_close(images[k], image, rtol=1e-5, atol=1e-6)
            for name, parameter in part.named_parameters():
                torch.testing.assert_close(batch.get_parameter(name).grad[k], parameter.grad, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
class TestHalf:
    """Half precision in: computed in float32, in the dtype of the colours out."""

    def test_function(self, field: GaussianField, labels: Tensor, dtype: torch.dtype) -> None:
        def render(*tensors: Tensor) -> Tensor:
            return region_splat(*tensors, field.region_ids, labels)

        halves = [p.detach().to(dtype).requires_grad_() for p in (field.means, field.cholesky, field.colors)]
        floats = [t.detach().float().requires_grad_() for t in halves]
        image, expected = render(*halves), render(*floats)
        assert image.dtype == dtype and torch.equal(image, expected.to(dtype))
        result = torch.autograd.grad(image.float().sum(), halves)
        for gradient, exact, leaf in zip(result, torch.autograd.grad(expected.sum(), floats), halves, strict=True):
            assert gradient.dtype == leaf.dtype == dtype and torch.equal(gradient, exact.to(dtype))
        # one of the three is enough, and the colours decide
        assert render(halves[0], floats[1], floats[2]).dtype == torch.float32
        assert render(floats[0], floats[1], halves[2]).dtype == dtype

    def test_field_keeps_pixel_positions(self, field: GaussianField, labels: Tensor, dtype: torch.dtype) -> None:
        """A field of half tensors is of float32, with and without a graph; so is what it renders."""
        for graph in (False, True):
            halves = [p.detach().to(dtype).requires_grad_(graph) for p in (field.means, field.cholesky, field.colors)]
            other = GaussianField(*(t * 1 for t in halves), field.region_ids, size=SIZE)
            image = RegionSplatRenderer()(other, labels)
            assert image.dtype == other.means.dtype == torch.float32
            image.sum().backward()
            assert not graph or all(t.grad is not None and t.grad.dtype == dtype for t in halves)

    def test_autocast(self, field: GaussianField, labels: Tensor, dtype: torch.dtype) -> None:
        """The splat of a network in half precision is evaluated in float32; filters after it are not its matter."""
        torch.manual_seed(0)
        network, chain = nn.Linear(4, 20 * 8), nn.Sequential(RegionSplatRenderer(keepdim=False), nn.Conv2d(3, 3, 3))
        with torch.autocast("cpu", dtype):
            raw = network(torch.randn(2, 4)).view(2, 20, 8)
            assert raw.dtype == dtype
            means, cholesky = 24 * raw[..., :2].sigmoid(), 1 + raw[..., 2:5].sigmoid()
            batch = GaussianField(means, cholesky, raw[..., 5:], size=SIZE).assign_regions(labels)
            image = RegionSplatRenderer()(batch, labels)
            assert batch.means.dtype == image.dtype == torch.float32 and chain(Scene(field, labels)).dtype == dtype
        assert torch.equal(image, RegionSplatRenderer()(batch, labels))
        image.square().sum().backward()
        assert network.weight.grad is not None and network.weight.grad.dtype == torch.float32
        assert network.weight.grad.isfinite().all() and network.weight.grad.any()
