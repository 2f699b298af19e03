"""A scene edited region by region, against what the picture must show then."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from kcgs import GaussianField, RegionMap, RegionSplatRenderer
from kcgs.nn import delete_region, extract_region, move_region, recolor_region, replace_background

SIZE = (48, 64)
BOX, DISC, GROUND = 4, 9, 1


def shapes(scale: int = 1) -> Tensor:
    """Draw a box and a disc on a ground, `scale` labels along a side of a pixel."""
    y, x = ((torch.arange(n * scale) + 0.5) / scale for n in SIZE)
    labels = torch.full((SIZE[0] * scale, SIZE[1] * scale), GROUND)
    labels[((y > 18) & (y < 30))[:, None] & ((x > 16) & (x < 28))[None, :]] = BOX
    labels[(y[:, None] - 24) ** 2 + (x[None, :] - 46) ** 2 < 49] = DISC
    return labels


MAPS = {
    "hard": lambda: RegionMap.from_labels(shapes()),
    "soft": lambda: RegionMap.from_labels(shapes(), 0.8),
    "pairs": lambda: RegionMap.from_labels(shapes(), {(GROUND, BOX): 1.0, (GROUND, DISC): 0.5}),
    "fine": lambda: RegionMap.from_labels(shapes(2), 0.6, supersample=2),
}


@pytest.fixture(params=MAPS)
def regions(request: pytest.FixtureRequest) -> RegionMap:
    return MAPS[request.param]()


def field_of(regions: RegionMap, opacities: bool = False) -> GaussianField:
    field = GaussianField.random(150, SIZE, regions=regions, seed=0)
    if not opacities:
        return field
    alpha = torch.linspace(0.2, 1.0, len(field))
    return GaussianField(field.means, field.cholesky, field.colors, field.region_ids, alpha, size=SIZE)


def draw(field: GaussianField, regions: RegionMap, size: tuple[int, int] | None = None) -> Tensor:
    return RegionSplatRenderer()(field, regions, size).detach()


def cut(field: GaussianField, regions: RegionMap, region: int, size: tuple[int, int] | None = None) -> Tensor:
    return extract_region(field, regions, region, size).detach()


class TestExtract:
    @pytest.mark.parametrize("size", [None, (96, 128), (30, 50)])
    def test_all_regions_together_are_the_picture(self, regions: RegionMap, size: tuple[int, int] | None) -> None:
        field = field_of(regions, opacities=True)
        cuts = torch.stack([cut(field, regions, r, size) for r in regions.ids.tolist()])
        torch.testing.assert_close(cuts[:, 3].sum(0), torch.ones(size or SIZE), rtol=0, atol=1e-6)
        picture = (cuts[:, :3] * cuts[:, 3:]).sum(0)
        torch.testing.assert_close(picture, draw(field, regions, size), rtol=0, atol=1e-5)

    def test_hard_alpha_is_the_mask(self) -> None:
        regions = MAPS["hard"]()
        rgba = cut(field_of(regions), regions, DISC)
        assert torch.equal(rgba[3], (regions.labels == DISC).float())
        assert not rgba[:3, regions.labels != DISC].any()

    def test_colour_is_straight_under_a_soft_contour(self) -> None:
        """A region of one colour has that colour wherever it has any share, however small."""
        regions = MAPS["soft"]()
        field = recolor_region(field_of(regions), DISC, 0.0, torch.tensor([0.9, 0.5, 0.1]))
        rgba = cut(field, regions, DISC)
        held = rgba[3] > 0
        assert 0 < rgba[3, held].min() < 1e-3 < 0.999 < rgba[3].max()
        want = torch.tensor([0.9, 0.5, 0.1])[:, None].expand(-1, int(held.sum()))
        torch.testing.assert_close(rgba[:3, held], want, rtol=0, atol=1e-5)
        assert not rgba[:3, ~held].any()

    def test_region_without_gaussians_is_black(self) -> None:
        regions = MAPS["hard"]()
        field = field_of(regions)
        assert field.region_ids is not None
        rgba = cut(field.subset(field.region_ids != BOX), regions, BOX)
        assert not rgba[:3].any() and rgba[3].sum() == 144

    def test_gradients_reach_the_field(self, regions: RegionMap) -> None:
        field = field_of(regions)
        rgba = extract_region(field, regions, DISC)
        (rgba[:3] * rgba[3:]).square().sum().backward()
        assert field.means.grad is not None and field.region_ids is not None
        moved = field.means.grad.abs().sum(-1) > 0
        assert moved.any() and not moved[field.region_ids != DISC].any()


class TestMove:
    @pytest.mark.parametrize("offset", [(-5, -3), (-7, 6), (0, 0)])
    def test_cut_out_is_shifted(self, regions: RegionMap, offset: tuple[int, int]) -> None:
        field = field_of(regions)
        before = cut(field, regions, BOX)
        moved = move_region(field, regions, BOX, offset)
        after = cut(*moved, BOX)
        torch.testing.assert_close(after, before.roll((offset[1], offset[0]), (1, 2)), rtol=0, atol=1e-5)

    def test_by_half_a_pixel_of_a_finer_map(self) -> None:
        regions = MAPS["fine"]()
        moved = move_region(field_of(regions), regions, DISC, (-0.5, 1))
        assert moved.regions.fine_labels is not None and regions.fine_labels is not None
        disc = (regions.fine_labels == DISC).roll((2, -1), (0, 1))
        assert torch.equal(moved.regions.fine_labels == DISC, disc)

    def test_nothing_else_changes(self, regions: RegionMap) -> None:
        field = field_of(regions)
        means, labels = field.means.detach().clone(), regions.labels.clone()
        moved = move_region(field, regions, BOX, (-4, 0))
        assert field.region_ids is not None
        still = field.region_ids != BOX
        assert torch.equal(moved.field.means[still], means[still])
        assert torch.equal(field.means, means) and torch.equal(regions.labels, labels)
        far = slice(36, None)  # columns that no blur reaches
        assert torch.equal(draw(*moved)[..., far], draw(field, regions)[..., far])

    def test_what_it_leaves_and_what_it_covers(self) -> None:
        regions = MAPS["hard"]()
        moved = move_region(field_of(regions), regions, BOX, (20, 0)).regions.labels
        assert (moved[18:30, 36:48] == BOX).all() and int((moved == BOX).sum()) == 144
        assert (moved[18:30, 16:28] == GROUND).all()
        assert int((moved == DISC).sum()) < int((regions.labels == DISC).sum())

    def test_out_of_the_picture(self) -> None:
        regions = MAPS["hard"]()
        gone = move_region(field_of(regions), regions, BOX, (1000, 0))
        assert gone.regions.ids.tolist() == [GROUND, DISC]
        part = move_region(field_of(regions), regions, BOX, (-22, 0)).regions.labels
        assert int((part == BOX).sum()) == 12 * 6

    def test_widths_of_new_neighbours(self) -> None:
        """The box has never touched the disc: their contour becomes as soft as the box has been."""
        moved = move_region(field_of(MAPS["pairs"]()), MAPS["pairs"](), BOX, (20, 0)).regions
        assert moved.softness == {(GROUND, BOX): 1.0, (GROUND, DISC): 0.5, (BOX, DISC): 1.0}  # type: ignore[comparison-overlap]


class TestRecolor:
    @pytest.mark.parametrize("opacities", [False, True])
    @pytest.mark.parametrize("gain", [0.5, torch.tensor([1.5, 0.0, 1.0]), torch.rand(3, 3)], ids=["1", "C", "CxC"])
    def test_picture_changes_by_the_formula(self, regions: RegionMap, gain: Tensor | float, opacities: bool) -> None:
        field, bias = field_of(regions, opacities), torch.tensor([0.2, 0.0, -0.1])
        changed = recolor_region(field, DISC, gain, bias)
        assert len(changed) == len(field) + 1
        before, after = cut(field, regions, DISC), cut(changed, regions, DISC)
        matrix = gain if isinstance(gain, Tensor) and gain.ndim == 2 else torch.eye(3) * gain
        want = torch.einsum("ij,jhw->ihw", matrix, before[:3]) + bias[:, None, None]
        torch.testing.assert_close(after[:3], torch.where(after[3] > 0, want, 0.0), rtol=0, atol=2e-5)
        torch.testing.assert_close(cut(changed, regions, BOX), cut(field, regions, BOX))

    @pytest.mark.parametrize("backend", ["reference", "tiled", "cpu"])
    def test_bias_is_flat_on_every_backend(self, backend: str) -> None:
        regions = MAPS["hard"]()
        field = recolor_region(field_of(regions), BOX, 0.0, 0.7)
        picture = RegionSplatRenderer(backend=backend)(field, regions)[:, regions.labels == BOX]
        torch.testing.assert_close(picture, torch.full_like(picture, 0.7), rtol=0, atol=2e-6)

    def test_without_bias_no_gaussian_is_added(self) -> None:
        field = field_of(MAPS["hard"]())
        again = recolor_region(field, BOX, 1.0)
        assert len(again) == len(field) and torch.equal(again.colors, field.colors)


class TestDelete:
    def test_no_trace_of_the_colour(self, regions: RegionMap) -> None:
        """Only the box is red: without it nothing is."""
        field = field_of(regions)
        for region, gain in ((BOX, (1.0, 0.0, 0.0)), (DISC, (0.0, 1.0, 1.0)), (GROUND, (0.0, 1.0, 1.0))):
            field = recolor_region(field, region, torch.tensor(gain))
        assert draw(field, regions)[0].max() > 0.1
        rest = delete_region(field, regions, BOX)
        assert draw(*rest)[0].abs().max() == 0.0
        assert rest.regions.ids.tolist() == [GROUND, DISC]
        assert rest.field.region_ids is not None and not (rest.field.region_ids == BOX).any()
        assert rest.regions.supersample == regions.supersample

    def test_pixels_go_to_the_nearest(self) -> None:
        labels = torch.tensor([[1, 1, 2, 2, 2, 3, 3], [1, 2, 2, 2, 2, 2, 3]])
        field = GaussianField.random(20, (2, 7), regions=labels, seed=0)
        left = delete_region(field, labels, 2).regions.labels
        # the middle one above is 2 from both and falls to the smaller id; below, both are nearer by the other row
        assert left.tolist() == [[1, 1, 1, 1, 3, 3, 3], [1, 1, 1, 1, 3, 3, 3]]

    def test_nearest_is_nearest(self) -> None:
        generator = torch.Generator().manual_seed(0)
        coarse = torch.randint(0, 5, (6, 8), generator=generator)
        labels = coarse.repeat_interleave(4, 0).repeat_interleave(4, 1)
        field = GaussianField.random(50, (24, 32), regions=labels, seed=0)
        got = delete_region(field, labels, 2).regions.labels
        stays = (labels != 2).nonzero()
        for y, x in (labels == 2).nonzero().tolist():
            squared = (stays - torch.tensor([y, x])).square().sum(1)
            assert got[y, x] == labels[tuple(stays[squared == squared.min()].T)].min()
        assert torch.equal(got[labels != 2], labels[labels != 2])


class TestReplaceBackground:
    def test_shares_blend(self, regions: RegionMap) -> None:
        field, background = field_of(regions), torch.rand(3, *SIZE, generator=torch.Generator().manual_seed(1))
        cuts = {r: cut(field, regions, r) for r in (BOX, DISC, GROUND)}
        got = replace_background(field, regions, GROUND, background)
        want = sum(cuts[r][:3] * cuts[r][3:] for r in (BOX, DISC)) + background * cuts[GROUND][3:]
        torch.testing.assert_close(got, want, rtol=0, atol=1e-5)

    def test_its_own_background_gives_the_picture_back(self, regions: RegionMap) -> None:
        field = field_of(regions)
        own = cut(field, regions, GROUND)[:3]
        torch.testing.assert_close(
            replace_background(field, regions, [GROUND], own), draw(field, regions), rtol=0, atol=1e-5
        )

    def test_all_of_it_is_the_background_at_its_size(self, regions: RegionMap) -> None:
        background = torch.rand(3, 100, 70, generator=torch.Generator().manual_seed(1))
        got = replace_background(field_of(regions), regions, regions.ids.tolist(), background)
        torch.testing.assert_close(got, background, rtol=0, atol=1e-6)

    def test_gradients_reach_background_and_field(self) -> None:
        regions, background = MAPS["soft"](), torch.rand(3, *SIZE, requires_grad=True)
        field = field_of(regions)
        replace_background(field, regions, [GROUND], background).sum().backward()
        assert background.grad is not None and field.colors.grad is not None
        torch.testing.assert_close(background.grad[0], cut(field, regions, GROUND)[3])
        assert field.region_ids is not None and not field.colors.grad[field.region_ids == GROUND].any()
        assert field.colors.grad[field.region_ids != GROUND].any()


class TestErrors:
    @pytest.mark.parametrize(
        ("edit", "error", "words"),
        [
            (lambda f, r: move_region(f, r, 2, (1, 0)), ValueError, "one of the 3 ids in the map; got 2"),
            (lambda f, r: move_region(f, r, BOX, (0.5, 0)), ValueError, "whole multiples of 1 pixel"),
            (lambda f, r: move_region(f, r, BOX, (float("nan"), 0)), ValueError, "whole multiples of 1 pixel"),
            (lambda f, r: move_region(f, r, BOX, (1,)), ValueError, r"offset must be \(dx, dy\)"),
            (lambda f, r: delete_region(f, r.resize((96, 128)), BOX), ValueError, r"one map of the size \(48, 64\)"),
            (lambda f, r: delete_region(f, torch.zeros(SIZE).long(), 0), ValueError, "another region"),
            (lambda f, r: delete_region(f, r, "box"), TypeError, "region_id must be an integer; got 'box'"),
            (lambda f, r: delete_region(f, "r", BOX), TypeError, "a RegionMap or a label map Tensor; got str"),
            (lambda f, r: recolor_region(f, 77, 0.5), ValueError, "one of the field's; got 77"),
            (lambda f, r: recolor_region(f, BOX, torch.ones(2)), ValueError, r"gain must have shape .*got \(2,\)"),
            (lambda f, r: recolor_region(f, BOX, "red"), TypeError, "gain must be a number or a Tensor"),
            (lambda f, r: recolor_region(f, BOX, 1.0, torch.eye(3)), ValueError, "bias must have shape"),
            (lambda f, r: extract_region(f, r, BOX, (0, 4)), ValueError, "size must be at least 1 x 1"),
            (lambda f, r: extract_region(GaussianField.random(3, SIZE), r, BOX), ValueError, "must have region_ids"),
            (lambda f, r: extract_region("f", r, BOX), TypeError, "field must be a GaussianField"),
            (lambda f, r: extract_region(f, shapes().expand(2, -1, -1), BOX), ValueError, "one map of the size"),
            (lambda f, r: replace_background(f, r, BOX, torch.zeros(1, 4, 4)), ValueError, r"shape \(3, H, W\)"),
            (lambda f, r: replace_background(f, r, [3], torch.zeros(3, 4, 4)), ValueError, "3 ids in the map; got 3"),
        ],
    )
    def test_bad_input(self, edit: object, error: type[Exception], words: str) -> None:
        regions = MAPS["hard"]()
        with pytest.raises(error, match=words):
            edit(field_of(regions), regions)  # type: ignore[operator]

    def test_batched(self) -> None:
        two = [torch.ones(2, 5, n) for n in (2, 3, 3)]
        field = GaussianField(*two, torch.zeros(2, 5, dtype=torch.long), size=SIZE)
        with pytest.raises(ValueError, match="field must not be batched"):
            recolor_region(field, 0, 0.5)

    def test_resized_soft_map(self) -> None:
        regions = RegionMap.from_labels(shapes(), 0.8).resize((96, 128))
        field = GaussianField.random(20, (96, 128), regions=regions, seed=0)
        with pytest.raises(ValueError, match="must not be resized"):
            move_region(field, regions, BOX, (2, 0))
