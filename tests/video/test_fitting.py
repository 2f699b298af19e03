"""Fits of videos, scenes between their frames, and edits of all frames."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from kcgs import GaussianField, RegionMap, Scene
from kcgs.editing import move_region, recolor_region
from kcgs.editing.masks import dilate
from kcgs.functional import psnr
from kcgs.video import delete_from_video, fit_video, interpolate, move_in_video
from kcgs.video.stacking import stack

SIZE = (48, 64)
SETTINGS: dict[str, Any] = {"num_gaussians": 80, "iterations": 200}


Y, X = torch.meshgrid(torch.arange(SIZE[0]) + 0.5, torch.arange(SIZE[1]) + 0.5, indexing="ij")
# waves that stand still
GROUND = (0.4 + 0.2 * torch.sin(X / 5) * torch.cos(Y / 7)).expand(3, -1, -1)


def moving_disc(time: float) -> tuple[Tensor, Tensor]:
    """Return a frame in which a bright disc moves 3 pixels per frame over the ground, and its label map."""
    inside = (X - 20 - 3 * time) ** 2 + (Y - 24 + time) ** 2 < 100
    disc = torch.stack([0.9 - (Y + time) / 200, 0.5 + (X - 3 * time) / 400, 0.2 + 0.1 * torch.sin(X - 3 * time)])
    return torch.where(inside, disc, GROUND), inside.long() * 7


FRAMES, MAPS = (list(parts) for parts in zip(*(moving_disc(time) for time in range(5)), strict=True))


@pytest.fixture(scope="module")
def scenes() -> Scene:
    return fit_video(iter(FRAMES), iter(MAPS), **SETTINGS)


@pytest.fixture(scope="module")
def moved(scenes: Scene) -> Scene:
    return move_in_video(scenes, 7, (10, 8))


class TestFitVideo:
    def test_error(self, scenes: Scene) -> None:
        assert len(scenes) == 5 and scenes.num_gaussians == 80
        assert scenes.metadata == {"frame_rate": "24"}
        psnrs = [float(psnr(scene.render(), frame)) for scene, frame in zip(scenes, FRAMES, strict=True)]
        assert min(psnrs) > psnrs[0] - 3.5 and min(psnrs) > 30
        assert scenes.regions is not None
        for labels, expected in zip(scenes.regions.labels, MAPS, strict=True):
            assert (labels != expected).float().mean() < 0.03

    def test_motion(self, scenes: Scene) -> None:
        """Gaussians of the disc move with it, and those of the ground stand still."""
        ids = scenes.field.region_ids
        assert ids is not None
        means, is_visible = scenes.field.means.detach(), scenes.field.colors.detach().abs().amax(-1) > 0.05
        steps = means[1:] - means[:-1]
        disc, ground = ((ids[1:] == k) & (ids[:-1] == k) & is_visible[1:] & is_visible[:-1] for k in (7, 0))
        assert torch.allclose(steps[disc].median(0)[0], torch.tensor([3.0, -1.0]), atol=0.7)
        assert steps[ground].norm(dim=-1).median() < 0.05

    def test_callback(self) -> None:
        assert len(fit_video(FRAMES, None, 8, iterations=2, on_frame=lambda number, _: number == 1)) == 2

    def test_softness_after_a_cut(self) -> None:
        """Contours have the softness of the first frame before and after a cut, in the batch and in each frame."""
        thirds = torch.arange(SIZE[1]) // 22
        other = torch.stack([0.9 * (thirds == k) for k in range(3)])[:, None].expand(3, *SIZE).contiguous()
        frames, maps = [FRAMES[0], other, other], [MAPS[0], thirds.expand(SIZE), thirds.expand(SIZE)]
        rendered: list[Tensor] = []
        settings = {"num_gaussians": 40, "iterations": 40, "on_frame": lambda _, scene: rendered.append(scene.render())}
        whole = fit_video(frames, maps, **settings)
        assert torch.allclose(whole.render(), torch.stack(rendered), atol=1e-5)

    def test_softness_of_regions_that_touch_in_one_frame_only(self) -> None:
        """Also where all contours of that frame have the same softness."""
        thirds, halves = torch.arange(SIZE[1]) // 22, 2 * (torch.arange(SIZE[1]) // 33)
        maps = RegionMap(thirds.expand(SIZE), {(0, 1): 0.5, (1, 2): 1.0}), RegionMap(halves.expand(SIZE), 0.7)
        frames = [Scene(GaussianField.random(9, SIZE, regions=regions, seed=0), regions) for regions in maps]
        regions = stack(frames, {}).regions
        assert regions is not None and regions.softness == {(0, 1): 0.5, (1, 2): 1.0, (0, 2): 0.7}

    def test_scene_cut(self) -> None:
        """A map of the first frame moves along until a cut; another shot is fitted anew, without it."""
        other = torch.rand(3, *SIZE, generator=torch.Generator().manual_seed(0)).mul(0.1)
        other[0, :, 30:] = 0.9
        frames = [*FRAMES[:3], other, other]
        scenes = fit_video(frames, MAPS[0], 80, iterations=100)
        assert scenes.regions is not None
        assert [len(labels.unique()) for labels in scenes.regions.labels] == [2, 2, 2, 1, 1]
        disc = scenes.regions.labels[2] == 7
        assert (disc & (MAPS[2] == 7)).sum() > 0.65 * (disc | (MAPS[2] == 7)).sum()
        assert min(float(psnr(scene.render(), frame)) for scene, frame in zip(scenes, frames, strict=True)) > 24

    def test_regions_come_and_go(self) -> None:
        empty = torch.zeros_like(MAPS[0])
        scenes = fit_video([FRAMES[0]] * 3, [empty, MAPS[0], empty], 80, iterations=80)
        assert scenes.regions is not None and scenes.regions.ids.tolist() == [0, 7]
        assert float(psnr(scenes[1].render(), FRAMES[0])) > 26

    @pytest.mark.parametrize("settings", [{"guidance": False}, {"objective": "ms-ssim"}])
    def test_without_regions(self, settings: dict[str, Any]) -> None:
        maps = MAPS if "guidance" in settings else None
        scenes = fit_video(FRAMES[:2], maps, 20, iterations=10, **settings)
        assert scenes.regions is None and scenes.field.region_ids is None and len(scenes) == 2

    @pytest.mark.parametrize(
        ("frames", "maps", "settings", "match"),
        [
            ([], None, {}, "frames must hold at least one frame; got none"),
            (FRAMES, MAPS[:1], {}, "label_maps must have a map for each frame, or be one map; got 1 for 5 frames"),
            (iter(FRAMES), iter(MAPS[:1]), {}, "label_maps must have a map for each frame, or be one map; got 1"),
            ([FRAMES[0], FRAMES[0][:, :24]], None, {}, r"frame 1 must have shape \(3, 48, 64\); got \(3, 24, 64\)"),
            (FRAMES, None, {"bounded": True}, "bounded must be False for a video; got True"),
        ],
    )
    def test_exceptions(
        self, frames: list[Tensor], maps: list[Tensor] | None, settings: dict[str, Any], match: str
    ) -> None:
        with pytest.raises(ValueError, match=match):
            fit_video(frames, maps, 8, iterations=2, **settings)

    @pytest.mark.parametrize("size", [(1, 5), (5, 1)])
    def test_tiny_frames(self, size: tuple[int, int]) -> None:
        frames = torch.rand(2, 3, *size, generator=torch.Generator().manual_seed(0))
        assert fit_video(frames, None, 3, iterations=5).render().shape == (2, 3, *size)

    def test_all_frames_have_the_least_width(self) -> None:
        scenes = fit_video(FRAMES[:2], None, 20, iterations=20, min_sigma=2.0)
        l11, l21, l22 = scenes.field.cholesky[1].detach().unbind(-1)
        factors = torch.stack([l11, torch.zeros_like(l11), l21, l22], -1).view(-1, 2, 2)
        assert torch.linalg.svdvals(factors).min() > 1.999


class TestInterpolate:
    def test_gaussians_of_both_frames_meet(self) -> None:
        means, cholesky = torch.tensor([[[24.5, 24.5]], [[28.5, 22.5]]]), torch.tensor([6.0, 0.0, 6.0]).expand(2, 1, 3)
        field = interpolate(Scene(GaussianField(means, cholesky, torch.full((2, 1, 3), 0.8), size=SIZE)), 0.25).field
        torch.testing.assert_close(field.means.detach(), torch.tensor([[25.5, 24.0]] * 2), atol=0.1, rtol=0.0)
        torch.testing.assert_close(field.colors.detach()[:, 0], torch.tensor([0.6, 0.2]))

    def test_error(self, scenes: Scene) -> None:
        """It is 2 dB lower than that of the mean of the frames, where something moves."""
        image, labels = moving_disc(3.0)
        every_second = scenes[::2]
        renders = interpolate(every_second, 1.5).render(), every_second[1:].render().mean(0)
        errors = [(render - image)[:, labels == 7].square().mean() for render in renders]
        assert errors[0] < 0.63 * errors[1]

    @pytest.mark.parametrize("time", [0.4, 0.6])
    def test_scene_cut(self, time: float) -> None:
        """No Gaussian of one shot is seen in the other."""
        other = (torch.arange(SIZE[1]) % 8 < 4).float().expand(3, *SIZE)
        scenes = fit_video([FRAMES[0], other], None, 40, iterations=30)
        assert torch.equal(interpolate(scenes, time).render(), scenes[round(time)].render())

    def test_whole_time(self, scenes: Scene) -> None:
        assert torch.equal(interpolate(scenes, 3).render(), scenes[3].render())

    def test_exceptions(self, scenes: Scene) -> None:
        with pytest.raises(ValueError, match=r"time must be in \[0, 4\] frames; got 4.5"):
            interpolate(scenes, 4.5)
        with pytest.raises(TypeError, match="scenes must be a batch of scenes; got a scene of one image"):
            interpolate(scenes[0], 0)


class TestEdits:
    def test_delete(self, scenes: Scene) -> None:
        """What the disc hides is taken from other frames."""
        edited = delete_from_video(scenes, 7)
        assert edited.regions is not None and edited.regions.ids.tolist() == [0]
        assert edited.num_gaussians == scenes.num_gaussians
        for number, other in ((0, 4), (4, 0)):
            pixels = (MAPS[number] == 7) & ~dilate(MAPS[other] == 7, 4)
            assert (edited[number].render() - GROUND)[:, pixels].square().mean() < 1e-4

    def test_move(self, scenes: Scene, moved: Scene) -> None:
        assert moved.regions is not None
        labels = moved.regions.labels[2]
        assert torch.equal(labels[8:, 10:] == 7, (scenes.regions.labels[2] == 7)[:-8, :-10])  # type: ignore[union-attr]
        inside = labels == 7
        difference = moved[2].render()[:, 8:, 10:] - scenes[2].render()[:, :-8, :-10]
        assert difference[:, inside[8:, 10:]].abs().mean() < 0.02

    def test_a_frame_moves_as_an_image_does(self, scenes: Scene, moved: Scene) -> None:
        image = move_region(scenes[2], 7, (10, 8))
        assert moved.regions is not None and image.regions is not None
        assert torch.equal(moved.regions.labels[2], image.regions.labels)
        assert moved.regions[2].softness == image.regions.softness

    def test_a_lost_region_is_told(self, scenes: Scene) -> None:
        with pytest.warns(UserWarning, match="regions 7 are lost: covered, or out of the image"):
            moved = move_in_video(scenes[:2], 7, (100, 0))
        moved.render()  # without a warning of rows whose region has no pixels

    def test_recolor(self, scenes: Scene) -> None:
        """All frames at once: the disc of each gets the same gain and bias."""
        edited = recolor_region(scenes, 7, 0.5, 0.1)
        assert edited.num_gaussians == scenes.num_gaussians + 1
        single = recolor_region(scenes[3], 7, 0.5, 0.1)
        torch.testing.assert_close(edited[3](), single(), rtol=0, atol=1e-6)

    @pytest.mark.parametrize(
        ("arguments", "match"),
        [
            ((3, (0, 0)), "region_ids must be among the 2 ids of the maps, 0, 7; got 3"),
            (([0, 7], (0, 0)), "region_ids must leave a region in every frame; got all regions of frame 0"),
            ((7, (8.4, 0.4)), "offset must"),
        ],
    )
    def test_exceptions(self, scenes: Scene, arguments: Any, match: str) -> None:
        with pytest.raises(ValueError, match=match):
            move_in_video(scenes, *arguments)

    def test_other_scenes(self, scenes: Scene) -> None:
        with pytest.raises(TypeError, match="scenes must be a batch of scenes; got a scene of one image"):
            delete_from_video(scenes[0], 7)
        with pytest.raises(ValueError, match="scenes must have a label map for each frame"):
            delete_from_video(Scene(scenes.field), 7)
