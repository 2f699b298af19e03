"""Fits of videos: rows keep their places, Gaussians follow what moves, and batches can be edited and interpolated."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from kcgs import Scene, load
from kcgs.editing import recolor_region
from kcgs.editing.masks import dilate
from kcgs.functional import psnr
from kcgs.video import delete_region, fit_video, interpolate, move_region

SIZE = (48, 64)
SETTINGS: dict[str, Any] = {"num_gaussians": 80, "iterations": 300}


def moving_disc(time: float) -> tuple[Tensor, Tensor]:
    """Return a frame in which a bright disc moves 3 pixels per frame over waves that stand still, and its label map."""
    y, x = torch.meshgrid(torch.arange(SIZE[0]) + 0.5, torch.arange(SIZE[1]) + 0.5, indexing="ij")
    ground = 0.4 + 0.2 * torch.sin(x / 5) * torch.cos(y / 7)
    inside = (x - 20 - 3 * time) ** 2 + (y - 24 + time) ** 2 < 100
    disc = torch.stack([0.9 - (y + time) / 200, 0.5 + (x - 3 * time) / 400, 0.2 + 0.1 * torch.sin(x - 3 * time)])
    return torch.where(inside, disc, ground.expand(3, -1, -1)), inside.long() * 7


FRAMES, MAPS = (list(parts) for parts in zip(*(moving_disc(time) for time in range(5)), strict=True))


@pytest.fixture(scope="module")
def scenes() -> Scene:
    return fit_video(FRAMES, MAPS, **SETTINGS)


def errors(scenes: Scene) -> list[float]:
    return [float(psnr(scene.render(), frame)) for scene, frame in zip(scenes, FRAMES, strict=True)]


class TestFitVideo:
    def test_frames_are_shown_well(self, scenes: Scene) -> None:
        assert len(scenes) == 5 and scenes.num_gaussians == 80
        assert scenes.metadata == {"frame_rate": "24"}
        values = errors(scenes)
        assert min(values) > values[0] - 1.5 and min(values) > 30
        assert scenes.regions is not None
        for labels, given in zip(scenes.regions.labels, MAPS, strict=True):
            assert (labels != given).float().mean() < 0.03

    def test_gaussians_follow_what_moves(self, scenes: Scene) -> None:
        ids = scenes.field.region_ids
        assert ids is not None
        means, shown = scenes.field.means.detach(), scenes.field.colors.detach().abs().amax(-1) > 0.05
        steps = means[1:] - means[:-1]
        disc, ground = ((ids[1:] == k) & (ids[:-1] == k) & shown[1:] & shown[:-1] for k in (7, 0))
        assert torch.allclose(steps[disc].median(0)[0], torch.tensor([3.0, -1.0]), atol=0.7)
        assert steps[ground].norm(dim=-1).median() < 0.05

    def test_same_arguments_same_scenes(self, scenes: Scene) -> None:
        again = fit_video(iter(FRAMES), iter(MAPS), **SETTINGS)
        assert torch.equal(again.field.means, scenes.field.means)
        assert torch.equal(again.field.colors, scenes.field.colors)

    def test_files_keep_every_bit(self, scenes: Scene, tmp_path: Path) -> None:
        scenes.save(tmp_path / "a.safetensors")
        loaded = load(tmp_path / "a.safetensors")
        assert torch.equal(loaded.render(), scenes.render()) and loaded.metadata == scenes.metadata

    def test_stops_when_asked(self) -> None:
        assert len(fit_video(FRAMES, None, 8, iterations=2, on_frame=lambda number, _: number == 1)) == 2

    def test_widths_after_a_cut(self) -> None:
        """Contours have the widths of the first frame before and after a cut, in the batch and in each frame."""
        halves = torch.arange(SIZE[1]) // 22
        other = torch.stack([0.9 * (halves == k) for k in range(3)])[:, None].expand(3, *SIZE).contiguous()
        frames, maps = [*FRAMES[:2], other, other], [*MAPS[:2], halves.expand(SIZE), halves.expand(SIZE)]
        rendered: list[Tensor] = []
        whole = fit_video(frames, maps, on_frame=lambda _, scene: rendered.append(scene.render()), **SETTINGS)
        assert torch.allclose(whole.render(), torch.stack(rendered), atol=1e-5)

    def test_the_map_of_the_first_frame_is_carried_on(self) -> None:
        scenes = fit_video(FRAMES, MAPS[0], **SETTINGS)
        assert scenes.regions is not None
        disc = scenes.regions.labels[4] == 7
        assert (disc & (MAPS[4] == 7)).sum() > 0.75 * (disc | (MAPS[4] == 7)).sum()

    def test_a_scene_cut(self) -> None:
        """Another shot is fitted anew; a map that was carried ends there, others do not."""
        other = torch.rand(3, *SIZE, generator=torch.Generator().manual_seed(0)).mul(0.1)
        other[0, :, 30:] = 0.9
        frames = [FRAMES[0], FRAMES[1], other, other]
        scenes = fit_video(frames, MAPS[0], **SETTINGS)
        assert scenes.regions is not None
        assert [len(labels.unique()) for labels in scenes.regions.labels] == [2, 2, 1, 1]
        assert min(float(psnr(scene.render(), frame)) for scene, frame in zip(scenes, frames, strict=True)) > 24

    def test_regions_come_and_go(self) -> None:
        empty = torch.zeros_like(MAPS[0])
        scenes = fit_video([FRAMES[0]] * 3, [empty, MAPS[0], empty], **SETTINGS)
        assert scenes.regions is not None and scenes.regions.ids.tolist() == [0, 7]
        assert float(psnr(scenes[1].render(), FRAMES[0])) > 27

    @pytest.mark.parametrize("settings", [{}, {"guidance": False}, {"objective": "ms-ssim"}])
    def test_without_confinement(self, settings: dict[str, Any]) -> None:
        maps = MAPS if "guidance" in settings else None
        scenes = fit_video(FRAMES[:2], maps, **SETTINGS, **settings)
        assert scenes.regions is None and scenes.field.region_ids is None and len(scenes) == 2

    def test_exceptions(self) -> None:
        with pytest.raises(ValueError, match="frames must hold at least one frame; got none"):
            fit_video([])
        with pytest.raises(ValueError, match=r"label_maps must have a map for each frame, or be one map; got 1"):
            fit_video(FRAMES, MAPS[:1], 8, iterations=2)
        with pytest.raises(ValueError, match=r"frame 1 must have shape \(3, 48, 64\); got \(3, 24, 64\)"):
            fit_video([FRAMES[0], FRAMES[0][:, :24]], None, 8, iterations=2)


class TestInterpolate:
    def test_between_frames(self, scenes: Scene) -> None:
        """Better than the mean of the frames about it, where something moves."""
        fitted = fit_video(FRAMES[::2], MAPS[::2], **SETTINGS)
        for number in (0, 1):
            image, labels = moving_disc(2.0 * number + 1)
            mean = fitted[number : number + 2].render().mean(0)
            inside = labels == 7
            found, blended = (
                (render - image)[:, inside].square().mean()
                for render in (interpolate(fitted, number + 0.5).render(), mean)
            )
            assert found < 0.63 * blended  # 2 dB

    def test_a_whole_time_is_the_frame(self, scenes: Scene) -> None:
        assert torch.equal(interpolate(scenes, 3).render(), scenes[3].render())

    def test_exceptions(self, scenes: Scene) -> None:
        with pytest.raises(ValueError, match=r"time must be in \[0, 4\] frames; got 4.5"):
            interpolate(scenes, 4.5)
        with pytest.raises(TypeError, match="scenes must be a batch of scenes; got a scene of one image"):
            interpolate(scenes[0], 0)


class TestEdits:
    def test_delete(self, scenes: Scene) -> None:
        """What the disc hides is seen in other frames."""
        edited = delete_region(scenes, 7)
        assert edited.regions is not None and edited.regions.ids.tolist() == [0]
        assert edited.num_gaussians == scenes.num_gaussians
        y, x = torch.meshgrid(torch.arange(SIZE[0]) + 0.5, torch.arange(SIZE[1]) + 0.5, indexing="ij")
        ground = (0.4 + 0.2 * torch.sin(x / 5) * torch.cos(y / 7)).expand(3, -1, -1)
        for number, other in ((0, 4), (4, 0)):
            shown = (MAPS[number] == 7) & ~dilate(MAPS[other] == 7, 4)
            scene = edited[number]
            assert (scene.render() - ground)[:, shown].square().mean() < 1e-4

    def test_move(self, scenes: Scene) -> None:
        moved = move_region(scenes, 7, (10, 8))
        assert moved.regions is not None
        labels = moved.regions.labels[2]
        assert torch.equal(labels[8:, 10:] == 7, (scenes.regions.labels[2] == 7)[:-8, :-10])  # type: ignore[union-attr]
        inside = labels == 7
        shift = moved[2].render()[:, 8:, 10:] - scenes[2].render()[:, :-8, :-10]
        assert shift[:, inside[8:, 10:]].abs().mean() < 0.02

    def test_recolor(self, scenes: Scene) -> None:
        """All frames at once: the disc of each gets the same gain and bias."""
        edited = recolor_region(scenes, 7, 0.5, 0.1)
        assert edited.num_gaussians == scenes.num_gaussians + 1
        single = recolor_region(scenes[3], 7, 0.5, 0.1)
        torch.testing.assert_close(edited[3](), single(), rtol=0, atol=1e-6)

    def test_exceptions(self, scenes: Scene) -> None:
        with pytest.raises(ValueError, match="region_ids must be among the 2 ids of the maps, 0, 7; got 3"):
            delete_region(scenes, 3)
        with pytest.raises(ValueError, match="region_ids must leave a region in every frame"):
            delete_region(scenes, [0, 7])
        with pytest.raises(TypeError, match="scenes must be a batch of scenes; got a scene of one image"):
            delete_region(scenes[0], 7)
        with pytest.raises(ValueError, match="offset must"):
            move_region(scenes, 7, (8.4, 0.4))
        with pytest.raises(ValueError, match="scenes must have a label map for each frame"):
            delete_region(Scene(scenes.field), 7)
