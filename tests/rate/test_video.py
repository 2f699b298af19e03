"""Videos become clips: what moves is followed, and every promise of `fit_video` holds on small frames."""

from __future__ import annotations

import copy
import warnings
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch
from kornia.geometry.transform import ImageRegistrator, warp_perspective
from torch import Tensor

from kcgs import Clip, FitConfig, GaussianField, Scene, fit_video
from kcgs.codec.clips.carried import Change, ClipPart
from kcgs.codec.clips.differences import Differences
from kcgs.codec.clips.file import ClipHeader
from kcgs.codec.clips.frames import FrameReader, begin_part, carried_record
from kcgs.codec.clips.motion import quantize_motion
from kcgs.codec.exact import Integers
from kcgs.data import Davis
from kcgs.functional import psnr
from kcgs.rate.video.budget import Budget
from kcgs.rate.video.carrying import Carrying
from kcgs.rate.video.encoder import VideoEncoder
from kcgs.rate.video.following import Following
from kcgs.rate.video.registration import register
from kcgs.rate.video.report import FrameReport

SIZE = (48, 64)
SETTINGS = {"num_gaussians": 60, "iterations": 40}


def moving_disc(number: int) -> tuple[Tensor, Tensor]:
    """Return a frame with a bright disc that moves over waves, and its label map."""
    y, x = torch.meshgrid(torch.arange(SIZE[0]) + 0.5, torch.arange(SIZE[1]) + 0.5, indexing="ij")
    ground = 0.4 + 0.2 * torch.sin((x + number) / 5) * torch.cos(y / 7)
    inside = (x - 20 - 3 * number) ** 2 + (y - 24 + number) ** 2 < 100
    image = torch.where(inside, torch.stack([0.9 - y / 200, 0.5 + x / 400, 0.2 + 0 * x]), ground.expand(3, -1, -1))
    return image, inside.long() * 7


FRAMES, MAPS = zip(*(moving_disc(number) for number in range(5)), strict=True)


@pytest.fixture(scope="module")
def clip() -> Clip:
    return fit_video(FRAMES, MAPS, **SETTINGS)


def test_frames_are_carried_on_and_shown_well(clip: Clip) -> None:
    assert len(clip) == 5 and clip.key_frames == (0,)
    shown = [float(psnr(scene.render(), frame)) for scene, frame in zip(clip, FRAMES, strict=True)]
    assert min(shown) > 40
    assert max(clip.frame_bytes[1:]) < 0.7 * clip.frame_bytes[0]
    for scene, labels in zip(clip, MAPS, strict=True):
        assert scene.regions is not None
        assert (scene.regions.labels != labels).float().mean() < 0.04


def test_the_same_frames_give_the_same_clip(clip: Clip) -> None:
    assert fit_video(iter(FRAMES), iter(MAPS), **SETTINGS).to_bytes() == clip.to_bytes()


def test_a_map_of_the_first_frame_is_carried_on() -> None:
    clip = fit_video(FRAMES, MAPS[0], **SETTINGS)
    regions = clip[4].regions
    assert regions is not None
    union = (regions.labels == 7) | (MAPS[4] == 7)
    both = (regions.labels == 7) & (MAPS[4] == 7)
    assert both.sum() / union.sum() > 0.8


def test_without_maps_there_are_no_regions() -> None:
    assert fit_video(FRAMES[:2], **SETTINGS)[1].regions is None


def test_a_scene_cut_begins_a_key_frame() -> None:
    noise = torch.rand(3, *SIZE, generator=torch.Generator().manual_seed(0))
    other = torch.nn.functional.avg_pool2d(noise[None], 7, 1, 3)[0]
    clip = fit_video([*FRAMES[:2], other], [*MAPS[:2], MAPS[0]], num_gaussians=60, iterations=20)
    assert clip.key_frames == (0, 2)


def soft_noise(count: int) -> list[torch.Tensor]:
    noise = torch.rand(count, 3, *SIZE, generator=torch.Generator().manual_seed(0))
    return list(torch.nn.functional.avg_pool2d(noise, 7, 1, 3))


def test_frames_that_have_nothing_in_common_are_key_frames_and_share_a_budget() -> None:
    clip = fit_video(soft_noise(7), target_bytes=3500, iterations=30)
    assert clip.key_frames[:3] == (0, 1, 2) and 3000 < clip.num_bytes <= 3500
    even, keys = clip.frame_bytes[2:], clip.frame_bytes[:2]
    assert max(even) < 1.6 * min(even) < min(keys)


def test_a_scene_cut_after_the_first_frame_has_the_bytes_of_a_key_frame() -> None:
    (other,) = soft_noise(1)
    panned = [other.roll(shift, 2) for shift in range(6)]
    clip = fit_video([FRAMES[0], *panned], target_bytes=4000, iterations=30)
    assert clip.key_frames == (0, 1) and clip.frame_bytes[1] > 2.5 * max(clip.frame_bytes[2:])


def test_a_frame_with_more_detail_may_show_less() -> None:
    (first,) = soft_noise(1)
    checks = 0.15 * (torch.arange(SIZE[0])[:, None] // 2 + torch.arange(SIZE[1]) // 2).remainder(2)
    reports: list[FrameReport] = []
    fit_video([first, first + checks], num_gaussians=60, iterations=30, on_frame=reports.append)
    assert reports[1].psnr < reports[0].psnr - 5 and not reports[1].is_key


def test_key_frames_come_as_often_as_is_asked() -> None:
    clip = fit_video(FRAMES, MAPS, num_gaussians=20, iterations=10, key_interval=2)
    assert clip.key_frames == (0, 2, 4)


def test_a_region_may_be_new_or_leave() -> None:
    third = MAPS[1].clone()
    third[40:, 50:] = 3
    assert fit_video(FRAMES[:2], [MAPS[0], third], **SETTINGS).key_frames == (0, 1)
    empty = torch.where(MAPS[1] == 7, 0.4, FRAMES[1])
    gone = fit_video([FRAMES[0], empty], [MAPS[0], torch.zeros_like(MAPS[0])], **SETTINGS)
    assert gone[1].regions is None or gone[1].regions.num_regions == 1


def test_a_clip_keeps_to_its_bytes() -> None:
    clip = fit_video(FRAMES, MAPS, target_bytes=4000, iterations=40)
    assert 3000 < clip.num_bytes <= 4000
    rated = fit_video(FRAMES[:3], MAPS, kbps=30, frame_rate=10, iterations=20)
    assert rated.num_bytes <= 30 * 125 * 3 / 10
    with pytest.raises(ValueError, match=r"target_bytes, or kbps, must allow \d{3} bytes for 5 frames; got 40"):
        fit_video(FRAMES, target_bytes=40, iterations=30)
    with pytest.raises(ValueError, match="length"):
        fit_video((frame for frame in FRAMES), target_bytes=900)


def test_a_stopped_fit_goes_on_to_the_same_clip(clip: Clip, tmp_path) -> None:
    path = tmp_path / "video.checkpoint"
    part = fit_video(FRAMES, MAPS, checkpoint=path, on_frame=lambda report: report.number == 2, **SETTINGS)
    assert len(part) == 3
    path.write_bytes(path.read_bytes()[:-5])  # killed while it was writing
    fitted = []
    whole = fit_video(
        FRAMES, MAPS, checkpoint=path, resume=True, on_frame=lambda r: fitted.append(r.number), **SETTINGS
    )
    assert fitted == [2, 3, 4] and whole.to_bytes() == clip.to_bytes()
    with pytest.raises(ValueError, match="other arguments"):
        fit_video(FRAMES, MAPS, checkpoint=path, resume=True, num_gaussians=50, iterations=40)
    with pytest.raises(ValueError, match="another video"):
        fit_video([frame[:, :40] for frame in FRAMES], checkpoint=path, resume=True, **SETTINGS)
    path.write_bytes(path.read_bytes()[:-50] + bytes(50))
    with pytest.raises(ValueError, match=r"video\.checkpoint' cannot be read: .* checksum"):
        fit_video(FRAMES, MAPS, checkpoint=path, resume=True, **SETTINGS)


def test_a_resumed_budget_is_that_of_the_whole(tmp_path) -> None:
    path, asked = tmp_path / "video.checkpoint", {"target_bytes": 1500, "iterations": 20}
    frames = FRAMES[:3]
    whole = fit_video(frames, MAPS, **asked)
    fit_video(frames, MAPS, checkpoint=path, on_frame=lambda report: report.number == 1, **asked)
    assert fit_video(frames, MAPS, checkpoint=path, resume=True, **asked).to_bytes() == whole.to_bytes()


@pytest.mark.parametrize("objective", ["visual", "psnr"])
def test_grey_frames_and_other_objectives(objective: str) -> None:
    clip = fit_video([frame[:1] for frame in FRAMES[:2]], MAPS[:2], objective=objective, **SETTINGS)
    assert clip[1].render().shape == (1, *SIZE)


@pytest.mark.parametrize(
    ("frames", "settings", "message"),
    [
        ([], {}, "at least one frame"),
        ([FRAMES[0], FRAMES[1][:, :30]], {}, "frames must have one size"),
        ([FRAMES[0], FRAMES[1] * 2], {}, "frame 1: image"),
        (FRAMES, {"label_maps": MAPS[:2]}, "label_maps"),
        (FRAMES[:1], {"num_gaussians": 0}, "num_gaussians"),
        (FRAMES[:1], {"key_interval": 0}, "key_interval"),
        (FRAMES[:1], {"frame_rate": 0}, "frame_rate"),
        (FRAMES[:1], {"target_bytes": 900, "kbps": 3}, "exclude"),
        (FRAMES[:1], {"max_seconds": 3}, "max_seconds"),
        (FRAMES[:1], {"resume": True}, "checkpoint"),
        (FRAMES[:1], {"speed": 3}, "unknown setting"),
    ],
)
def test_bad_arguments_are_named(frames, settings, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        fit_video(frames, **{"num_gaussians": 20, "iterations": 5, **settings})


def test_frame_rates_are_kept_as_fractions() -> None:
    clip = fit_video(FRAMES[:1], num_gaussians=20, iterations=5, frame_rate=Fraction(30000, 1001))
    assert Clip.from_bytes(clip.to_bytes()).frame_rate == Fraction(30000, 1001)


def test_the_motion_of_a_region_is_found() -> None:
    generator = torch.Generator().manual_seed(0)
    noise = torch.nn.functional.avg_pool2d(torch.rand(1, 3, 140, 180, generator=generator), 9, 1, 4)
    y, x = torch.meshgrid(torch.arange(96) + 0.5, torch.arange(128) + 0.5, indexing="ij")

    def view(a: float, shift: tuple[float, float]) -> Tensor:
        u, v = a * x + 20 + shift[0], a * y + 20 + shift[1]
        grid = torch.stack([2 * u / 180 - 1, 2 * v / 140 - 1], -1)[None]
        return torch.nn.functional.grid_sample(noise, grid, align_corners=False)[0]

    source, target = view(1.0, (0, 0)), view(1.02, (5.0, -3.0))
    mask = torch.ones(96, 128, dtype=torch.bool)
    found = register(source, target, mask)
    # the point that was at p is where 1.02 q + shift = p
    expected = torch.tensor([[1 / 1.02, 0, -5 / 1.02], [0, 1 / 1.02, 3 / 1.02]]).double()
    assert (found - expected).abs()[:, :2].max() < 2e-3 and (found - expected).abs()[:, 2].max() < 0.15
    assert torch.equal(register(source, target, torch.zeros_like(mask)), torch.eye(3).double()[:2])


def test_inference_mode_and_warnings_do_no_harm() -> None:
    with torch.inference_mode(), warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(fit_video(FRAMES[:2], MAPS[:2], **SETTINGS)) == 2


def test_a_frame_that_can_only_stand_is_read_though_its_map_lost_a_region(monkeypatch) -> None:
    scenes = VideoEncoder(FitConfig(iterations=20), 60, 0, 9)
    record, _ = scenes.add(*moving_disc(0))
    reader = FrameReader(ClipHeader(SIZE, 3, Fraction(24)))
    reader.read(record)
    scenes._budget = Budget(400, 2, reader.header, 9)
    scenes._budget._left = 126
    monkeypatch.setattr(scenes, "_affords_key", lambda: False)
    record, report = scenes.add(FRAMES[1], torch.zeros_like(MAPS[1]))
    assert not report.is_key and len(record.data) < 30
    assert reader.read(record).index.max() == 1


def test_gaussians_that_get_too_thin_are_left_out_or_kept_wide_enough() -> None:
    field = GaussianField.random(40, SIZE, seed=0)
    with torch.no_grad():
        field.cholesky[:20, 2] = 1.05e-3
        field.cholesky[20:30, 2] = 2.5e-3
    part = begin_part(Scene(field), None)
    smaller = quantize_motion(np.array([[1.2, 0.0, -6.0], [0.0, 1.2, -5.0]]), SIZE)[None]
    carrying = Carrying(part, smaller, FRAMES[0], None, FitConfig(), 128)
    for change in (carrying.stand(), carrying.fit(60, 0)):
        assert change.gone[:20].all() and not change.gone[20:].all()
        frame = part_after(part, smaller, change).frame
        assert frame.gaussians.cholesky[:, ::2].min() > 1e-3
    following = Following(FRAMES[0], None, None, Differences(part.frame.gaussians, 0.05, SIZE), 0, 0.1)
    following.take(following.gaussians, torch.full_like(following.speed, -50.0))
    following.descend(9)
    assert following.gaussians[1][:, ::2].min() == following.gaussians[1].new_tensor(2e-3)


def part_after(part: ClipPart, numbers: Integers, change: Change) -> ClipPart:
    ahead = copy.deepcopy(part)
    carried_record(ahead, 128, numbers, change)
    return ahead


@pytest.mark.slow
def test_regions_are_followed_better_than_frames_are_registered(data_root: Path) -> None:
    davis = Davis(data_root / "DAVIS")
    gains = []
    for name in ("dog", "train"):
        sequence = davis.sequence(name)
        source, target, labels = sequence[12].image, sequence[13].image, sequence[12].labels
        registrator = ImageRegistrator("homography", num_iterations=100, tolerance=0.0)
        registrator.register(source[None], target[None])
        warped = registrator.warp_dst_into_src(target[None])[0].detach()
        for region in labels.unique():
            mask = labels == region
            ours = followed(target, register(source, target, mask))
            gains.append(float(psnr(ours * mask, source * mask) - psnr(warped * mask, source * mask)))
    assert min(gains) > 0 and sum(gains) / len(gains) > 3


def followed(target: Tensor, motion: Tensor) -> Tensor:
    """Return the source that a motion from it to the target finds there."""
    height, width = target.shape[1:]
    matrix = torch.eye(3, dtype=torch.float64)
    matrix[:2] = motion
    # kornia's homographies are between centres of pixels at whole numbers
    half = torch.tensor([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
    matrix = torch.linalg.inv(torch.linalg.inv(half) @ matrix @ half)
    return warp_perspective(target[None], matrix[None].float(), (height, width), padding_mode="border")[0]
