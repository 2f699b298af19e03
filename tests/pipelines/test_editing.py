"""A scene edited region by region, against what the image must show then."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from kcgs import GaussianField, RegionMap, Scene
from kcgs.editing import (
    delete_region,
    extract_region,
    move_region,
    recolor_region,
    render_over,
    render_region,
    replace_background,
)
from kcgs.functional import PairSoftness, region_splat
from kcgs.nn import scaled_gaussians
from tests.tester import BaseTester

SIZE = (48, 64)
BOX, DISC, GROUND = 4, 9, 1


def shapes() -> Tensor:
    """Make a box and a disc on a ground."""
    y, x = (torch.arange(n) + 0.5 for n in SIZE)
    labels = torch.full(SIZE, GROUND)
    labels[((y > 18) & (y < 30))[:, None] & ((x > 16) & (x < 28))[None, :]] = BOX
    labels[(y[:, None] - 24) ** 2 + (x[None, :] - 46) ** 2 < 49] = DISC
    return labels


MAPS = {
    "hard": RegionMap(shapes()),
    "soft": RegionMap(shapes(), 0.8),
    "pairs": RegionMap(shapes(), {(GROUND, BOX): 1.0, (GROUND, DISC): 0.5}),
}


@pytest.fixture
def regions() -> RegionMap:
    return MAPS["pairs"]


RESIZED = RegionMap(shapes(), 0.8).resize((96, 128))


def scene_of(regions: RegionMap, opacities: bool = False) -> Scene:
    field = GaussianField.random(150, regions.size, regions=regions, seed=0)
    if opacities:
        alpha = torch.linspace(0.2, 1.0, field.num_gaussians)
        field = GaussianField(field.means, field.cholesky, field.colors, field.region_ids, alpha, size=field.size)
    return Scene(field, regions, {"title": "shapes"})


def cut(scene: Scene, region: int, size: tuple[int, int] | None = None) -> Tensor:
    return render_region(scene, region, size, clamp=False).detach()


EDITS = {
    "move": lambda s: move_region(s, BOX, (-4, 2)),
    "recolor": lambda s: recolor_region(s, DISC, 0.5, 0.1),
    "delete": lambda s: delete_region(s, [BOX], fill=False),
    "extract": lambda s: extract_region(s, [BOX, DISC]),
    "background": lambda s: replace_background(s, GROUND, recolor_region(s, GROUND, 0.0, 0.9)),
}
Edit = Callable[[Scene], Scene]


@pytest.fixture(params=EDITS)
def edit(request: pytest.FixtureRequest) -> Edit:
    return EDITS[request.param]


WITHOUT = {
    "test_cardinality": "scenes are of one image, and keep their size",
    "test_dynamo": "edits are made outside of graphs, and return a Scene",
}


class TestEditing(BaseTester, without=WITHOUT):
    @pytest.mark.parametrize("kind", MAPS)
    def test_smoke(self, edit: Edit, kind: str, device: torch.device, dtype: torch.dtype) -> None:
        scene = scene_of(MAPS[kind], opacities=True).to(device, torch.promote_types(dtype, torch.float32))
        edited = edit(scene)
        image = edited()
        assert image.dtype == scene.field.colors.dtype and image.device.type == device.type
        assert image.isfinite().all() and image.shape == (3, *SIZE) and not torch.equal(image, scene())
        assert edited.size == edited.regions.size == SIZE and edited.metadata == {"title": "shapes"}
        assert torch.isin(edited.field.region_ids, edited.regions.ids).all()

    @pytest.mark.parametrize(
        ("edit", "error", "words"),
        [
            (lambda s: move_region(s, 2, (1, 0)), ValueError, "among the 3 ids of the map, 1, 4, 9; got 2"),
            (lambda s: move_region(s, BOX, (0.5, 0)), ValueError, "whole multiples of 1 pixel"),
            (lambda s: move_region(s, BOX, (float("nan"), 0)), ValueError, "offset must be finite; got nan"),
            (lambda s: move_region(s, BOX, (1,)), ValueError, r"offset must be \(dx, dy\)"),
            (lambda s: delete_region(s, [BOX, DISC, GROUND]), ValueError, "leave a region .*got all 3"),
            (lambda s: delete_region(s, []), ValueError, "region_ids must hold an id"),
            (lambda s: delete_region(s, "box"), TypeError, "region_ids must be an integer; got 'b'"),
            (lambda s: delete_region((s.field, s.regions), BOX), TypeError, "scene must be a Scene; got tuple"),
            (lambda s: delete_region(Scene(s.field), BOX), ValueError, "scene must have a label map"),
            (lambda s: recolor_region(grey(), BOX, 0.5), ValueError, "scene must have region ids; call scene.field"),
            (lambda s: recolor_region(s, 77, 0.5), ValueError, r"ids of the Gaussians, 1, 4, 9; got 77"),
            (lambda s: recolor_region(s, BOX, torch.ones(2)), ValueError, r"gain must have shape .*got \(2,\)"),
            (lambda s: recolor_region(s, BOX, "red"), TypeError, "gain must be a number"),
            (lambda s: recolor_region(s, BOX, [1.0, "a", 0.0]), TypeError, "gain must hold numbers; got"),
            (lambda s: recolor_region(s, BOX, 1.0, torch.eye(3)), ValueError, "bias must have shape"),
            (lambda s: recolor_region(s, BOX), ValueError, "color must be given, .*; got both or neither"),
            (lambda s: recolor_region(s, BOX, 1.0, strength=0.5), ValueError, "strength must be None without color"),
            (lambda s: recolor_region(s, BOX, color="reddish"), ValueError, "color must be a name such as red"),
            (lambda s: recolor_region(s, BOX, color=[1.0, 0.0]), ValueError, r"color must have shape \(3,\)"),
            (
                lambda s: recolor_region(Scene(s.field, torch.full_like(s.regions.labels, GROUND)), BOX, color="red"),
                ValueError,
                "region_ids must be of regions with pixels in the map; got",
            ),
            (lambda s: render_region(s, BOX, (0, 4)), ValueError, "size must be at least 1 x 1"),
            (lambda s: render_region(Scene(GaussianField.random(3, SIZE), s.regions), BOX), ValueError, "region ids"),
            (lambda s: render_region(Scene(s.field, shapes().expand(2, -1, -1)), BOX), ValueError, "hold 1 map"),
            (lambda s: render_over(s, BOX, torch.zeros(1, 4, 4)), ValueError, r"shape \(3, H, W\)"),
            (lambda s: replace_background(scene_of(RESIZED), BOX, s), ValueError, "must not have a resized map"),
            (lambda s: replace_background(s, BOX, torch.zeros(3, 4, 4)), TypeError, "background must be a Scene"),
            (lambda s: replace_background(s, BOX, grey()), ValueError, "background must have 3 channels; got 1"),
        ],
    )
    def test_exception(self, edit: Callable[[Scene], object], error: type[Exception], words: str) -> None:
        with pytest.raises(error, match=words):
            edit(scene_of(MAPS["hard"]))

    def test_exception_batched(self) -> None:
        two = [torch.ones(2, 5, n) for n in (2, 3, 3)]
        field = GaussianField(*two, torch.zeros(2, 5, dtype=torch.long), size=SIZE)
        batch = Scene(field, torch.zeros(2, *SIZE, dtype=torch.long))
        match = r"scene must be of one image; got a batch of 2: scene\[t\] is one of them"
        with pytest.raises(ValueError, match=match):
            extract_region(batch, 0)
        with pytest.raises(ValueError, match=match + ", and kcgs.video edits"):
            delete_region(batch, 0)

    def test_feature(self, edit: Edit, regions: RegionMap) -> None:
        """An edit makes a new scene: nothing of the one given changes, nor is shared with it."""
        scene = scene_of(regions)
        before = scene().detach(), regions.labels.clone()
        edited = edit(scene)
        with torch.no_grad():
            for tensor in edited.field.parameters():
                tensor.fill_(1.0)
        assert torch.equal(scene(), before[0]) and torch.equal(regions.labels, before[1])

    def test_gradcheck(self) -> None:
        """Of what renders regions, by the Gaussians and by the background."""
        scene = scene_of(MAPS["pairs"])
        ids = scene.field.region_ids
        few = scene.field.subset(torch.cat([(ids == r).nonzero()[:2, 0] for r in (BOX, DISC, GROUND)]))
        background = torch.rand(3, *SIZE, generator=torch.Generator().manual_seed(1))

        def render(background: Tensor, *tensors: Tensor) -> Tensor:
            field = GaussianField(*(1 * t for t in tensors), few.region_ids, size=SIZE)
            made = Scene(field, scene.regions)
            return torch.cat([render_region(made, [BOX, DISC], clamp=False)[:3], render_over(made, GROUND, background)])

        self.gradcheck(render, (background, few.means, few.cholesky, few.colors))

    def test_module(self, edit: Edit, regions: RegionMap) -> None:
        """The Gaussians of an edited scene can be trained."""
        edited = edit(scene_of(regions))
        edited().square().sum().backward()
        assert all(p.is_leaf and p.grad.any() for p in edited.parameters())


class TestRenderRegion:
    @pytest.mark.parametrize(("kind", "size"), [("hard", None), ("soft", (30, 50)), ("pairs", (96, 128))])
    def test_all_regions_together_are_the_image(self, kind: str, size: tuple[int, int] | None) -> None:
        regions = MAPS[kind]
        scene = scene_of(regions, opacities=True)
        cuts = torch.stack([cut(scene, r, size) for r in regions.ids.tolist()])
        torch.testing.assert_close(cuts[:, 3].sum(0), torch.ones(size or SIZE), rtol=0, atol=1e-6)
        image = (cuts[:, :3] * cuts[:, 3:]).sum(0)
        torch.testing.assert_close(image, scene(size).detach(), rtol=0, atol=1e-5)

    def test_hard_alpha_is_the_mask(self) -> None:
        """A region without Gaussians is black."""
        scene = scene_of(MAPS["hard"])
        disc = scene.regions.labels == DISC
        for field in (scene.field, scene.field.subset(scene.field.region_ids != DISC)):
            rgba = cut(Scene(field, scene.regions), DISC)
            assert torch.equal(rgba[3], disc.float()) and not rgba[:3, ~disc].any()
            assert bool(rgba[:3, disc].any()) == (field is scene.field)

    def test_colour_is_straight_under_a_soft_contour(self) -> None:
        """A region of one colour has that colour wherever it has any share, however small."""
        scene = recolor_region(scene_of(MAPS["soft"]), DISC, 0.0, torch.tensor([0.9, 0.5, 0.1]))
        rgba = cut(scene, DISC)
        inside = rgba[3] > 0
        assert 0 < rgba[3, inside].min() < 1e-3 < 0.999 < rgba[3].max()
        expected = torch.tensor([0.9, 0.5, 0.1])[:, None].expand(-1, int(inside.sum()))
        torch.testing.assert_close(rgba[:3, inside], expected, rtol=0, atol=1e-5)
        assert not rgba[:3, ~inside].any()

    def test_colours_are_clipped_unless_asked_otherwise(self) -> None:
        scene = scene_of(MAPS["soft"])
        with torch.no_grad():
            scene.field.colors.mul_(9.0).sub_(2.0)
        plain = cut(scene, BOX)
        assert plain.max() > 1.0 and plain.min() < 0.0
        assert torch.equal(render_region(scene, BOX).detach(), plain.clamp(0.0, 1.0))

    def test_several_regions_are_their_blend(self, regions: RegionMap) -> None:
        scene = scene_of(regions)
        rgba, disc, box = render_region(scene, [BOX, DISC], clamp=False).detach(), cut(scene, DISC), cut(scene, BOX)
        torch.testing.assert_close(rgba[3], disc[3] + box[3], rtol=0, atol=1e-6)
        expected = disc[:3] * disc[3] + box[:3] * box[3]
        torch.testing.assert_close(rgba[:3] * rgba[3], expected, rtol=0, atol=1e-5)


class TestExtract:
    def test_only_the_region_is_left(self, regions: RegionMap) -> None:
        scene = scene_of(regions)
        rgba = cut(scene, DISC)
        alone = extract_region(scene, DISC)
        torch.testing.assert_close(alone().detach(), rgba[:3] * rgba[3], rtol=0, atol=1e-5)
        assert alone.metadata == scene.metadata and set(alone.field.region_ids.tolist()) == {DISC}
        assert alone.regions.num_regions == 3 and "3 regions, 2 of them without a Gaussian" in repr(alone)
        both = extract_region(scene, [DISC, BOX])
        assert set(both.field.region_ids.tolist()) == {BOX, DISC}


class TestMove:
    def test_cut_out_is_shifted(self, regions: RegionMap) -> None:
        scene = scene_of(regions)
        before = cut(scene, BOX)
        moved = move_region(scene, BOX, (-7, 6), fill=False)
        after = cut(moved, BOX)
        torch.testing.assert_close(after, before.roll((6, -7), (1, 2)), rtol=0, atol=1e-5)

    def test_two_regions_move_together(self) -> None:
        scene = scene_of(MAPS["hard"])
        moved = move_region(scene, [BOX, DISC], (-4, 2), fill=False).regions.labels
        for region in (BOX, DISC):
            assert torch.equal(moved == region, (scene.regions.labels == region).roll((2, -4), (0, 1)))

    def test_nothing_else_changes(self, regions: RegionMap) -> None:
        scene = scene_of(regions)
        result = move_region(scene, BOX, (-4, 0), fill=False)
        others = scene.field.region_ids != BOX
        assert torch.equal(result.field.means[others], scene.field.means[others])
        far = slice(36, None)  # columns that no blur reaches
        assert torch.equal(result().detach()[..., far], scene().detach()[..., far])

    def test_covered_and_out_of_the_image(self) -> None:
        regions = MAPS["hard"]
        with pytest.warns(UserWarning, match=f"regions {BOX} are lost: covered, or out of the image"):
            gone = move_region(scene_of(regions), BOX, (1000, 0), fill=False)
        assert gone.regions.ids.tolist() == [GROUND, DISC]
        with pytest.warns(UserWarning, match=f"regions {BOX}, {DISC} are lost"):
            move_region(scene_of(regions), [BOX, DISC], (0, -1000), fill=False)
        part = move_region(scene_of(regions), BOX, (-22, 0), fill=False).regions.labels
        assert int((part == BOX).sum()) == 12 * 6
        over = move_region(scene_of(regions), BOX, (20, 0), fill=False).regions.labels
        assert (over[18:30, 36:48] == BOX).all() and (over[18:30, 16:28] == GROUND).all()

    def test_softness_of_new_neighbours(self) -> None:
        """The box has never touched the disc: their contour becomes as soft as contours are on the mean."""
        moved = move_region(scene_of(MAPS["pairs"]), BOX, (20, 0), fill=False).regions
        assert moved.softness == {(GROUND, BOX): 1.0, (GROUND, DISC): 0.5, (BOX, DISC): 0.75}


def luma(scene: Scene) -> Tensor:
    return torch.einsum("chw,c->hw", scene().detach(), torch.tensor([0.299, 0.587, 0.114]))


class TestRecolor:
    @pytest.mark.parametrize(
        ("gain", "opacities"),
        [(0.5, False), (torch.tensor([1.5, 0.0, 1.0]), True), (torch.linspace(0, 1, 9).view(3, 3), False)],
        ids=["1", "C", "CxC"],
    )
    def test_image_changes_by_the_formula(self, regions: RegionMap, gain: Tensor | float, opacities: bool) -> None:
        scene, bias = scene_of(regions, opacities), torch.tensor([0.2, 0.0, -0.1])
        changed = recolor_region(scene, DISC, gain, bias)
        assert changed.num_gaussians == scene.num_gaussians + 1
        before, after = cut(scene, DISC), cut(changed, DISC)
        matrix = gain if isinstance(gain, Tensor) and gain.ndim == 2 else torch.eye(3) * gain
        expected = torch.einsum("ij,jhw->ihw", matrix, before[:3]) + bias[:, None, None]
        torch.testing.assert_close(after[:3], torch.where(after[3] > 0, expected, 0.0), rtol=0, atol=2e-5)
        torch.testing.assert_close(cut(changed, BOX), cut(scene, BOX))

    def test_lists_and_arrays_are_tensors(self) -> None:
        scene, gain = scene_of(MAPS["hard"]), [1.4, 1.0, 0.6]
        expected = recolor_region(scene, BOX, torch.tensor(gain), torch.tensor(gain))().detach()
        for other in (gain, tuple(gain), np.array(gain), torch.diag(torch.tensor(gain)).tolist()):
            torch.testing.assert_close(recolor_region(scene, BOX, other, gain)().detach(), expected)

    @pytest.mark.parametrize(("level", "added"), [(0.6, 0), (0.1, 1)])
    def test_a_colour_keeps_the_shading(self, level: float, added: int) -> None:
        """The brightest tenth has it; luma falls in proportion, and in a dark region four times as fast as it did."""
        scene = scene_of(MAPS["hard"])
        pixels = scene.regions.labels == BOX

        def brightest() -> float:
            return float(luma(scene)[pixels].sort().values[math.ceil(0.9 * int(pixels.sum())) - 1])

        scene = recolor_region(scene, BOX, level / brightest())
        changed, color = (
            recolor_region(scene, BOX, color="#001a33", strength=1.0),
            torch.tensor([0.0, 26 / 255, 51 / 255]),
        )
        assert changed.num_gaussians == scene.num_gaussians + added
        ratio = 1 + (luma(scene)[pixels] - brightest()) / max(level, 0.25)
        torch.testing.assert_close(changed().detach()[:, pixels], color[:, None] * ratio, rtol=0, atol=1e-4)
        torch.testing.assert_close(changed().detach()[:, ~pixels], scene().detach()[:, ~pixels], rtol=0, atol=1e-5)

    @pytest.mark.parametrize(("glint", "is_flatter"), [(1.2, False), (2.0, True)])
    def test_a_colour_does_not_clip(self, glint: float, is_flatter: bool) -> None:
        """A twentieth of the box is brighter than the rest: it stays so, and the rest gets a bit darker."""
        labels = shapes()
        y, x = (labels == BOX).nonzero().T
        levels = torch.linspace(0.0, 0.4, len(y))
        levels[-len(y) // 20 :] *= glint
        size = torch.full((len(y),), 0.05)
        field = GaussianField(
            torch.stack([x, y], -1) + 0.5, torch.stack([size, 0 * size, size], -1), levels[:, None].expand(-1, 3),
            labels[y, x], size=SIZE,
        )  # fmt: skip
        changed = recolor_region(Scene(field, labels), BOX, color="red", strength=1)().detach()[0, y, x]
        assert changed.max() == pytest.approx(1.0, abs=1e-3) and changed.diff().min() >= -1e-4
        assert 0.74 < changed[int(0.9 * len(y))] < 0.9 and (changed[0] > 0.1) == is_flatter

    def test_a_share_of_the_old_colour_stays(self) -> None:
        scene = scene_of(MAPS["hard"])
        whole = recolor_region(scene, BOX, color="red", strength=1.0)().detach()
        before = scene().detach()
        for strength, options in ((0.75, {}), (0.2, {"strength": 0.2}), (0.0, {"strength": 0.0})):
            mixed = recolor_region(scene, BOX, color="red", **options)().detach()
            torch.testing.assert_close(mixed, before.lerp(whole, strength), rtol=0, atol=2e-5)

    def test_a_resized_map(self, regions: RegionMap) -> None:
        """A scene that was enlarged, and then recoloured, is the scene that was recoloured before."""
        scene = scene_of(regions)
        means, cholesky = scaled_gaussians(scene.field, RESIZED.size)
        field = GaussianField(means, cholesky, scene.field.colors, scene.field.region_ids, size=RESIZED.size)
        enlarged = Scene(field, scene.regions.resize(RESIZED.size))
        first, second = (recolor_region(s, BOX, color="red").render(RESIZED.size) for s in (scene, enlarged))
        assert (first - scene.render(RESIZED.size)).abs().max() > 0.1
        torch.testing.assert_close(second, first, rtol=0, atol=0.01)


class TestDelete:
    def test_no_trace_of_the_colour(self, regions: RegionMap) -> None:
        """Only the box is red: without it nothing is."""
        scene = scene_of(regions)
        for region, gain in ((BOX, (1.0, 0.0, 0.0)), (DISC, (0.0, 1.0, 1.0)), (GROUND, (0.0, 1.0, 1.0))):
            scene = recolor_region(scene, region, torch.tensor(gain))
        assert scene().detach()[0].max() > 0.1
        rest = delete_region(scene, BOX, fill=False)
        assert rest().detach()[0].abs().max() == 0.0
        assert rest.regions.ids.tolist() == [GROUND, DISC] and not (rest.field.region_ids == BOX).any()
        assert delete_region(scene, [BOX, DISC], fill=False).regions.ids.tolist() == [GROUND]

    def test_nearest_is_nearest(self) -> None:
        generator = torch.Generator().manual_seed(0)
        coarse = torch.randint(0, 5, (6, 8), generator=generator)
        labels = coarse.repeat_interleave(4, 0).repeat_interleave(4, 1)
        result = delete_region(scene_of(RegionMap(labels)), 2, fill=False).regions.labels
        stays = (labels != 2).nonzero()
        for y, x in (labels == 2).nonzero().tolist():
            squared = (stays - torch.tensor([y, x])).square().sum(1)
            assert result[y, x] in labels[tuple(stays[squared == squared.min()].T)]
        assert torch.equal(result[labels != 2], labels[labels != 2])


class TestRenderOver:
    def test_shares_blend(self, regions: RegionMap) -> None:
        scene, background = scene_of(regions), torch.rand(3, *SIZE, generator=torch.Generator().manual_seed(1))
        cuts = {r: cut(scene, r) for r in (BOX, DISC, GROUND)}
        result = render_over(scene, GROUND, background)
        expected = sum(cuts[r][:3] * cuts[r][3:] for r in (BOX, DISC)) + background * cuts[GROUND][3:]
        torch.testing.assert_close(result, expected, rtol=0, atol=1e-5)

    def test_all_of_it_is_the_background_at_its_size(self, regions: RegionMap) -> None:
        background = torch.rand(3, 100, 70, generator=torch.Generator().manual_seed(1))
        result = render_over(scene_of(regions), regions.ids.tolist(), background)
        torch.testing.assert_close(result, background, rtol=0, atol=1e-6)


class TestReplaceBackground:
    @pytest.mark.parametrize("size", [SIZE, (30, 80)])
    def test_the_rest_stays_and_the_background_shows(self, size: tuple[int, int]) -> None:
        scene = scene_of(MAPS["hard"])
        other = Scene(GaussianField.random(60, size, seed=3))
        result = replace_background(scene, GROUND, other)
        image, ground = result().detach(), scene.regions.labels == GROUND
        torch.testing.assert_close(image[:, ~ground], scene().detach()[:, ~ground], rtol=0, atol=1e-6)
        expected = region_splat(*scaled_gaussians(other.field, SIZE), other.field.colors, size=SIZE).detach()
        torch.testing.assert_close(image[:, ground], expected[:, ground], rtol=0, atol=1e-5)
        assert result.metadata == scene.metadata

    def test_regions_of_the_background_stay_apart(self) -> None:
        other = scene_of(RegionMap((torch.arange(64) // 20).expand(SIZE)), opacities=True)
        scene = scene_of(MAPS["soft"])
        result = replace_background(scene, [GROUND, BOX], other)
        assert result.regions.ids.tolist() == [DISC, *range(DISC + 1, DISC + 5)]
        hard = replace_background(Scene(scene.field, scene.regions.labels), [GROUND, BOX], other)
        outside = scene.regions.labels != DISC
        torch.testing.assert_close(hard().detach()[:, outside], other().detach()[:, outside], rtol=0, atol=1e-5)

    def test_contours_keep_their_softness(self) -> None:
        scene = scene_of(RegionMap(shapes(), {(GROUND, BOX): 0.5, (GROUND, DISC): 0.9}))
        halves = RegionMap((torch.arange(64) // 32).expand(SIZE), 1.5)
        result = replace_background(scene, GROUND, scene_of(halves)).regions.softness
        first = DISC + 1
        assert isinstance(result, PairSoftness) and result[first, first + 1] == 1.5
        assert {value for pair, value in result.items() if max(pair) >= first > min(pair)} == {0.7}


def grey() -> Scene:
    return Scene(GaussianField.random(3, SIZE, channels=1, seed=0))
