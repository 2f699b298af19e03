"""Fits of batches: each image gets what it gets alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from skimage import data
from torch import Tensor

from kcgs import FitResult, GaussianField, fit
from kcgs.functional import psnr
from kcgs.optim import GaussianAdam

from .test_own_loss import AddAll


def photos(channels: int = 3, count: int = 3) -> Tensor:
    """Crops of a photo, one of them saturated."""
    photo = torch.from_numpy(data.astronaut() / 255).float().permute(2, 0, 1)
    crops = [photo[:, y : y + 40, x : x + 56] for y, x in ((20, 190), (90, 200), (180, 100))][:count]
    images = torch.stack([*crops[:1], (crops[1] > 0.5).float(), *crops[2:]])
    return torch.cat([images, images.flip(-1)], 1)[:, :channels].contiguous()


def rows_in_use(field: GaussianField) -> list[Tensor]:
    """Return the tables of the rows of an image that have a colour."""
    mask = (field.colors != 0).any(-1)
    ids = [] if field.region_ids is None else [field.region_ids[mask]]
    return [table.detach()[mask] for table in (field.means, field.cholesky, field.colors)] + ids


def assert_same_rows(first: GaussianField, second: GaussianField) -> None:
    for actual, expected in zip(rows_in_use(first), rows_in_use(second), strict=True):
        assert torch.equal(actual, expected)


def assert_as_alone(batch: FitResult, images: Tensor, **settings: Any) -> None:
    for k, image in enumerate(images):
        alone = fit(image, **settings)
        assert_same_rows(batch.scene[k].field, alone.scene.field)
        assert float(batch.psnr[k]) == alone.psnr
        assert int(batch.num_pruned[k]) == alone.num_pruned


@pytest.mark.parametrize(("objective", "channels"), [("l2", 3), ("l1", 5), ("ms-ssim", 1)])
def test_each_image_gets_the_scene_that_it_gets_alone(objective: str, channels: int) -> None:
    """All events, growth, removals and the end of drafts, happen to images that are saturated and that are not."""
    settings: dict[str, Any] = {"num_gaussians": 30, "objective": objective, "iterations": 60, "seed": 3}
    images = photos(channels)
    result = fit(images, **settings)
    assert len(result.scene) == 3 and result.scene.num_gaussians == 30
    assert_as_alone(result, images, **settings)


def test_one_image_in_four_dimensions_is_a_batch() -> None:
    image = photos()[:1]
    result = fit(image, None, 20, iterations=30)
    assert len(result.scene) == len(result.psnr) == 1 and result.scene.render().shape == image.shape
    assert_as_alone(result, image, num_gaussians=20, iterations=30)


def test_the_history_has_means() -> None:
    images = photos()
    batch, alone = fit(images, None, 20, iterations=10), [fit(image, None, 20, iterations=10) for image in images]
    for k, entry in enumerate(batch.history):
        entries = [result.history[k] for result in alone]
        assert entry.psnr == pytest.approx(sum(one.psnr for one in entries) / 3)
        assert entry.loss == pytest.approx(sum(one.loss for one in entries) / 3)
    assert f"FitResult({float(batch.psnr.mean()):.2f} dB, stopped by iterations" in repr(batch)


def test_rows_without_use_have_the_colour_0_and_stay() -> None:
    """A black image is right from the start; the others do not notice."""
    images = photos()
    images[2] = 0.0
    settings: dict[str, Any] = {"num_gaussians": 60, "iterations": 60, "prune": 0.0}
    result = fit(images, **settings)
    unused = (result.scene.field.colors == 0).all(-1).sum(1)
    assert unused[2] > 0 and not unused[:2].any()
    assert_as_alone(result, images[:2], **settings)
    assert not result.scene.render()[2].any() and result.psnr[2] == result.history[-1].psnr == torch.inf


class Faulty(GaussianAdam):
    """Breaks an image at the 31st step, and twice more later."""

    image = 1
    num_steps = 0

    def step(self, closure: Any = None) -> Any:
        super().step(closure)
        self.num_steps += 1
        if self.num_steps in (31, 45, 60):
            with torch.no_grad():
                self.param_groups[0]["params"][0][self.image] = torch.nan


class Late(Faulty):
    image = 0


def test_an_image_that_diverges_keeps_its_best_and_the_others_go_on() -> None:
    settings: dict[str, Any] = {"num_gaussians": 30, "iterations": 60, "prune": 0.0}
    expected = fit(photos(), **settings)
    with pytest.warns(UserWarning, match="image 1 of the batch diverged at iteration 31: the best so far is kept"):
        result = fit(photos(), optimizer=Faulty, **settings)
    assert result.stop_reason == "iterations" and result.diverged == (1,)
    assert [result.of_image(image).diverged for image in (0, 1, -2)] == [(), (0,), (0,)]
    for k in (0, 2):
        assert_same_rows(result.scene[k].field, expected.scene[k].field)
    rendered = result.scene.render()
    torch.testing.assert_close(psnr(rendered, photos()), result.psnr.float(), rtol=1e-4, atol=1e-3)
    assert 8 < result.psnr[1] < expected.psnr[1]
    assert all(entry.psnr == entry.psnr for entry in result.history)


def test_divergence_at_the_last_step_is_told() -> None:
    with pytest.warns(UserWarning, match="the fit diverged at iteration 31"):
        assert fit(photos()[0], None, 30, iterations=31, optimizer=lambda field: Late(field)).diverged == (0,)


def test_a_batch_of_which_no_image_is_left_ends() -> None:
    with pytest.warns(UserWarning, match="diverged"):
        result = fit(photos(count=2), None, 30, iterations=100, learning_rate_factor=1e30, optimizer="adan")
    assert result.stop_reason == "diverged" and result.psnr.isfinite().all()


def halves(edges: list[int], ids: tuple[int, int] = (3, 7)) -> Tensor:
    """Make a map of two regions for each image, with an upright contour."""
    return torch.stack([torch.where(torch.arange(56) < x, *ids).expand(40, 56) for x in edges])


@pytest.mark.parametrize("recipe", ["best", "paper"])
def test_with_maps_each_image_gets_what_it_gets_alone(recipe: str) -> None:
    """Contours move and get their widths, image by image; the number of Gaussians grows by the number of regions."""
    images, labels = photos(), halves([20, 28, 36])
    labels[1:, 20:, :20], labels[2, :10, :10], labels[2, 30:, 45:] = 9, 1, 4
    images[:, :, :, :20] *= 0.3
    arguments: dict[str, Any] = {"num_gaussians": 60, "iterations": 60, "recipe": recipe}
    result = fit(images, labels, **arguments)
    assert result.scene.regions is not None and result.regions is not None
    for k, image in enumerate(images):
        alone = fit(image, labels[k], **arguments)
        scene = result.scene[k]
        assert scene.regions.softness == alone.scene.regions.softness
        assert torch.equal(scene.regions.labels, alone.scene.regions.labels)
        assert_same_rows(scene.field, alone.scene.field)
        assert result.regions[k] == alone.regions and float(result.psnr[k]) == alone.psnr
    moved = [report.moved_pixels for report in result.regions]
    assert any(moved) == (recipe == "best")


def test_one_map_for_all_images() -> None:
    images, labels = photos(), halves([30])[0]
    result, each = (fit(images, maps, 30, iterations=20) for maps in (labels, labels.expand(3, -1, -1)))
    assert torch.equal(result.scene.render(), each.scene.render()) and result.regions == each.regions


def test_maps_of_several_numbers_of_regions() -> None:
    """Images start with as many rows; more regions than Gaussians are merged, and a map of one region is no map."""
    labels = torch.stack([*halves([20]), torch.full((40, 56), 5), torch.arange(40 * 56).view(40, 56) // 56])
    with pytest.warns(UserWarning, match="20 of 43 regions were merged with others"):
        result = fit(photos(), labels, 20, iterations=40)
    counts = [len(scene.regions.labels.unique()) for scene in result.scene]
    assert counts == [2, 1, 20] and [report.num_after for report in result.regions] == counts
    for k, scene in enumerate(result.scene):
        assert torch.isin(scene.field.region_ids, scene.regions.ids).all()
        # the image of many regions has all its Gaussians from the start, the others get theirs later
        assert k == 2 or float(result.psnr[k]) > fit(photos()[k], labels[k], 20, iterations=40).psnr - 0.5
    torch.testing.assert_close(psnr(result.scene.render(), photos()), result.psnr.float(), rtol=1e-3, atol=0)


def test_a_region_whose_gaussians_were_pruned_is_reported_as_black() -> None:
    """As alone, where its Gaussians are gone."""
    images, labels = photos(), halves([20, 28, 36])
    images[:, :, labels[0] == 7] = 0.0
    settings: dict[str, Any] = {"prune": 0.01, "softness": 0.0, "move_contours": False, "densify_from": 1.0}
    report = fit(images[0], labels[0], 30, iterations=20, **settings).regions
    assert report.empty == 1 and report == fit(images, labels, 30, iterations=20, **settings).regions[0]


@pytest.mark.parametrize("one_region", [False, True])
def test_without_guidance_or_contours_there_is_no_map(one_region: bool) -> None:
    labels = torch.full((3, 40, 56), 5) if one_region else halves([20, 28, 36])
    result = fit(photos(), labels, 20, iterations=5, guidance=one_region)
    assert result.scene.regions is None and result.scene.field.region_ids is None
    assert [report.dropped for report in result.regions] == [None if one_region else "recipe"] * 3
    assert (result.history[-1].ef_psnr == result.history[-1].ef_psnr) != one_region


def test_an_event_of_ones_own_sees_the_batch() -> None:
    settings: dict[str, Any] = {"num_gaussians": 40, "iterations": 20, "densify": AddAll()}
    result = fit(photos(), **settings)
    assert result.scene.num_gaussians == 31
    assert_as_alone(result, photos(), **settings)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"target_psnr": 30.0}, "target_psnr must be None with 3 images: fit them one by one; got 30.0"),
        ({"objective": torch.mean}, "objective must be a name with 3 images: fit them one by one; got <built-in"),
        ({"checkpoint": Path("state")}, "checkpoint must be None with 3 images: fit them one by one; got Posix"),
    ],
)
def test_what_takes_one_image(change: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        fit(**{"image": photos(), **change})


def test_a_batch_that_does_not_fit_is_refused_with_the_size_that_would(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("kcgs._memory.free_memory", lambda: 1e8)
    images = torch.zeros(1, 1, 1, 1).expand(500, 3, 64, 64)
    with pytest.raises(
        ValueError, match=r"image has 500 images, which need about 0.5 GB .*; 0.1 GB are free: at most 10. fit"
    ):
        fit(images, None, 128)
