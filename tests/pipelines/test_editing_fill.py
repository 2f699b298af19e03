"""Holes of deleted and moved regions, filled from what is around them."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np
import pytest
import torch
from torch import Tensor

from kcgs import GaussianField, RegionMap, Scene, fit
from kcgs.editing import delete_region, move_region
from kcgs.editing.inpainting import inpaint, inpaint_from_matches
from kcgs.editing.masks import dilate
from kcgs.editing.montage import choose_layers

SIZE = (48, 72)


def object_mask() -> Tensor:
    y, x = (torch.arange(n) + 0.5 for n in SIZE)
    return (y[:, None] - 24) ** 2 / 120 + (x[None, :] - 30) ** 2 / 200 < 1


def photo(channels: int = 3) -> Tensor:
    """A waving ground, and a bright object on it."""
    y, x = torch.meshgrid(torch.arange(SIZE[0]), torch.arange(SIZE[1]), indexing="ij")
    ground = torch.stack([0.45 + 0.2 * torch.sin(x / (6.0 + k) + y / 9.0) for k in range(channels)])
    return torch.where(object_mask(), 0.95, ground).float()


@pytest.fixture(scope="module")
def scene() -> Scene:
    return fit(photo(), object_mask().long(), 120, iterations=150).scene


def slope(image: Tensor) -> Tensor:
    down, across = np.gradient(image.double().numpy(), axis=(1, 2))
    return torch.from_numpy(np.hypot(down, across).max(0))


def same(one: Scene, other: Scene) -> bool:
    pairs = zip(one.state_dict().items(), other.state_dict().items(), strict=True)
    return all(torch.equal(a, b) for (name, a), (_, b) in pairs if isinstance(a, Tensor))


def test_hole_is_in_range_and_about_as_steep_as_around(scene: Scene) -> None:
    hole = object_mask()
    before, after = (delete_region(scene, 1, fill=f)().detach() for f in (False, True))
    assert after[:, hole].min() > -0.02 and after[:, hole].max() < 1.02
    assert slope(after)[hole].max() <= 1.5 * slope(after)[~hole].quantile(0.999)
    assert (after - before)[:, ~dilate(hole, 6)].abs().max() < 0.06
    # the ground goes on: what was bright is not, nor is it black
    assert 0.2 < after[:, hole].min() and after[:, hole].max() < 0.75


def test_colours_that_bleed_out_of_the_mask_are_gone() -> None:
    """A mask that is two pixels too small: of the bright object's outline nothing is left."""
    inside = -torch.nn.functional.max_pool2d(-object_mask()[None].float(), 5, 1, 2)[0] > 0
    regions = RegionMap(inside.long())
    scene = fit(photo(), regions, 150, iterations=150, move_contours=False).scene
    before, after = (delete_region(scene, 1, fill=f)().detach()[:, ~inside] for f in (False, True))
    assert before.max() > 0.85 and after.max() < 0.75


def test_thin_region_beside_the_hole_stays() -> None:
    """A bar all of which is near the hole."""
    bar = torch.zeros(SIZE).bool()
    bar[20:28, 42:44] = True
    labels = torch.where(bar, 2, object_mask().long())
    scene = fit(torch.where(bar, 0.1, photo()), labels, 150, iterations=100, move_contours=False).scene
    difference = (delete_region(scene, 1)() - scene()).detach().abs()[:, bar]
    assert difference.max() < 0.15  # it is 0.35 darker than the ground


def test_same_bits_again(scene: Scene) -> None:
    assert same(delete_region(scene, 1), delete_region(scene, 1))


def move(scene: Scene, region: int) -> Scene:
    return move_region(scene, region, (8, 0))


def test_move_fills_what_it_uncovers(scene: Scene) -> None:
    moved = move_region(scene, 1, (9, 0))
    landed = moved.regions.labels == 1
    today = move_region(scene, 1, (9, 0), fill=False)
    torch.testing.assert_close(moved()[:, landed], today()[:, landed], rtol=0, atol=1e-5)
    left = object_mask() & ~landed
    assert moved().detach()[:, left].max() < 0.75 and moved().detach()[:, left].min() > 0.2


def test_move_that_uncovers_nothing_is_not_fitted(scene: Scene) -> None:
    assert same(move_region(scene, 1, (0, 0)), move_region(scene, 1, (0, 0), fill=False))


@pytest.mark.parametrize(("channels", "dtype", "edit"), [(1, torch.float64, delete_region), (4, torch.float32, move)])
def test_channels_dtypes_opacities_and_soft_maps(
    channels: int, dtype: torch.dtype, edit: Callable[[Scene, int], Scene]
) -> None:
    labels = object_mask().long()
    labels[:10] += 4
    regions = RegionMap(labels, {(0, 1): 0.8, (0, 4): 0.4})
    field = GaussianField.random(50, SIZE, channels=channels, regions=regions, seed=0, dtype=dtype)
    alpha = torch.linspace(0.2, 1.0, field.num_gaussians, dtype=dtype)
    scene = Scene(GaussianField(field.means, field.cholesky, field.colors, field.region_ids, alpha, size=SIZE), regions)
    edited = edit(scene, 1)
    assert edited().dtype == dtype and edited().shape == (channels, *SIZE) and edited().isfinite().all()
    assert edited.field.opacities is not None and edited.field.opacities.shape == (edited.num_gaussians,)


def test_hole_of_one_pixel_and_no_gaussian_left() -> None:
    labels = torch.zeros(5, 7).long()
    labels[2, 3] = 1
    field = GaussianField(
        torch.tensor([[3.5, 2.5]]), torch.ones(1, 3), torch.ones(1, 3), torch.tensor([1]), size=(5, 7)
    )
    assert delete_region(Scene(field, labels), 1)().abs().max() < 0.02


def test_match_continues_an_edge_where_a_mean_blurs_it() -> None:
    """Bright above dark, and a hole across the edge; elsewhere a pattern that does not look like it."""
    image = torch.full((3, 64, 120), 0.2)
    image[:, :30] = 0.8
    image[:, :, 80:] = torch.rand(3, 64, 40, generator=torch.Generator().manual_seed(0))
    hole = torch.zeros(64, 120).bool()
    hole[20:44, 10:26] = True
    fills = (fill(torch.where(hole, 0.0, image), hole)[:, hole] for fill in (inpaint, inpaint_from_matches))
    blurred, sharp = ((pixels - image[:, hole]).abs().mean() for pixels in fills)
    assert blurred > 0.05 and sharp < 0.02


def test_parts_of_a_hole_have_places_of_their_own() -> None:
    """Two patterns, one above the other, whose periods have no multiple in the image in common."""
    y, x = torch.meshgrid(torch.arange(64), torch.arange(128), indexing="ij")
    image = 0.5 + 0.3 * torch.sin(2 * torch.pi * x / torch.where(y < 32, 10, 14)).expand(3, -1, -1)
    hole = torch.zeros(64, 128).bool()
    hole[6:58, 54:76] = True
    smooth, copied = (fill(torch.where(hole, 0.0, image), hole)[:, hole] for fill in (inpaint, inpaint_from_matches))
    blurred, sharp = ((pixels - image[:, hole]).abs().mean() for pixels in (smooth, copied))
    assert sharp < 0.5 * blurred


def test_steps_find_the_best_choice_of_three() -> None:
    """Compared with all 729; a wrong cost of pixels that have changed before would miss it."""
    generator = torch.Generator().manual_seed(22)
    layers, costs = 0.1 * torch.rand(3, 3, 4, 5, generator=generator), 0.5 * torch.rand(3, 4, 5, generator=generator)
    hole = torch.zeros(4, 5).bool()
    hole[1:3, 1:4] = True

    def cost(labels: Tensor) -> float:
        total = float(costs.gather(0, labels[None])[0][hole].sum())
        for y, x, (down, right) in product(range(4), range(5), ((1, 0), (0, 1))):
            pair = [(y, x), (y + down, x + right)]
            if not any(0 < row < 3 and 0 < column < 4 for row, column in pair):  # none is in the hole
                continue
            one, other = (int(labels[place]) for place in pair)
            seen = [place for place in pair if not hole[place]] or pair
            total += sum(float((layers[one, :, *place] - layers[other, :, *place]).norm()) for place in seen)
        return total

    numbers = product(range(3), repeat=6)
    choices = [torch.zeros(4, 5, dtype=torch.int64).masked_scatter(hole, torch.tensor(choice)) for choice in numbers]
    assert cost(choose_layers(layers, costs, hole)) == pytest.approx(min(map(cost, choices)), abs=1e-3)


def test_hole_without_a_match_is_smooth() -> None:
    """Every place differs from the surroundings of the hole, or reaches beyond the image."""
    image = torch.full((3, 40, 60), 0.1)
    image[:, :, 30:] = 0.9
    hole = torch.zeros(40, 60).bool()
    hole[4:36, 4:56] = True
    difference = inpaint_from_matches(image, hole) - inpaint(image, hole)
    assert difference.abs().max() < 0.05
