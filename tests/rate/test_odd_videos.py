"""Videos that are not as one expects: black, of maps that come late, of budgets that are hard to keep, of two minds."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from kcgs import Clip, fit_video
from kcgs.codec import CodecError
from kcgs.codec.clips.carried import ClipPart
from kcgs.functional import psnr

SIZE = (32, 48)
FEW = {"num_gaussians": 30, "iterations": 20}
LEFT = (torch.arange(SIZE[1]) < 24).long().expand(SIZE)


def smooth(number: int) -> Tensor:
    x, y = torch.meshgrid(torch.arange(SIZE[1]) + number, torch.arange(SIZE[0]), indexing="xy")
    return torch.stack([0.5 + 0.3 * torch.sin(x / 9), 0.5 + 0.3 * torch.cos(y / 7), 0.4 + 0.004 * x])


TEXTURE = torch.nn.functional.interpolate(
    torch.rand(1, 3, 4, 4, generator=torch.Generator().manual_seed(0)), (12, 12), mode="bicubic"
)[0].clamp(0, 1)


def square(number: int) -> tuple[Tensor, Tensor]:
    """Return a frame with a textured square that moves by a pixel, and its map."""
    x, y = torch.meshgrid(torch.arange(SIZE[1]), torch.arange(SIZE[0]), indexing="xy")
    left = 10 + number
    inside = (x >= left) & (x < left + 12) & (y >= 10) & (y < 22)
    image = TEXTURE[:, (y - 10).clamp(0, 11), (x - left).clamp(0, 11)]
    return torch.where(inside, image, 0.35 + 0.005 * y.expand(3, -1, -1)), inside.long()


SQUARES, MAPS = zip(*(square(number) for number in range(6)), strict=True)


@pytest.mark.parametrize("first", [None, torch.zeros_like(LEFT)])
def test_regions_that_come_late_begin_a_key_frame(first: Tensor | None) -> None:
    clip = fit_video([smooth(0), *SQUARES[1:3]], [first, *MAPS[1:3]], **FEW)
    assert clip.key_frames[:2] == (0, 1) and clip[0].regions is None
    assert all(clip[number].regions is not None for number in (1, 2))


def test_a_map_that_the_fit_makes_one_region_begins_no_key_frames() -> None:
    clip = fit_video([smooth(0)] * 3, [torch.zeros_like(LEFT)] * 3, **FEW)
    assert clip.key_frames == (0,)


def test_where_all_gaussians_leave_a_key_frame_begins() -> None:
    first = torch.where(LEFT == 1, 0.7, 0.0).expand(3, -1, -1)
    clip = fit_video([first, torch.zeros(3, *SIZE)], [LEFT, torch.zeros_like(LEFT)], **FEW)
    assert clip.key_frames == (0, 1) and clip[1].render().abs().max() < 0.01


def test_a_video_may_begin_in_black() -> None:
    clip = fit_video([torch.zeros(3, *SIZE), *SQUARES[:2]], **FEW)
    assert clip[0].render().abs().max() == 0
    assert float(psnr(clip[2].render(), SQUARES[1])) > 20


def test_a_map_that_is_carried_moves_at_key_frames_too() -> None:
    clip = fit_video(SQUARES, MAPS[0], num_gaussians=60, iterations=60, move_contours=False, key_interval=1)
    regions = clip[5].regions
    assert clip.key_frames == tuple(range(6)) and regions is not None
    found, true = regions.labels == 1, MAPS[5] == 1
    assert (found & true).sum() > 0.8 * (found | true).sum()


def test_a_resumed_fit_knows_the_map_that_a_key_frame_was_given(tmp_path) -> None:
    maps = [MAPS[0], None, None, MAPS[3]]
    whole = fit_video(SQUARES[:4], maps, key_interval=2, **FEW)
    path = tmp_path / "state"
    fit_video(SQUARES[:4], maps, key_interval=2, checkpoint=path, on_frame=lambda r: r.number == 2, **FEW)
    again = fit_video(SQUARES[:4], maps, key_interval=2, checkpoint=path, resume=True, **FEW)
    assert again.to_bytes() == whole.to_bytes()


def test_a_checkpoint_of_other_frames_or_maps_is_refused(tmp_path) -> None:
    path = tmp_path / "state"
    fit_video(SQUARES[:2], MAPS[:2], checkpoint=path, **FEW)
    for frames, maps in (((smooth(0), smooth(1)), MAPS[:2]), (SQUARES[:2], (MAPS[0], MAPS[5]))):
        with pytest.raises(ValueError, match="another video: frame [01] or its map differs"):
            fit_video(frames, maps, checkpoint=path, resume=True, **FEW)


def test_a_budget_leaves_no_frame_standing_that_it_has_bytes_for() -> None:
    frames = [square(number)[0] for number in range(8)]
    clip = fit_video(frames, num_gaussians=30, iterations=20, target_bytes=2000)
    assert 1500 < clip.num_bytes <= 2000
    shown = [float(psnr(scene.render(), frame)) for scene, frame in zip(clip, frames, strict=True)]
    assert min(clip.frame_bytes) > 40 and min(shown) > 22


def test_a_budget_is_shared_among_key_frames_to_come() -> None:
    clip = fit_video(SQUARES, num_gaussians=30, iterations=20, target_bytes=1600, key_interval=2)
    assert clip.key_frames == (0, 2, 4)
    keys = [clip.frame_bytes[number] for number in clip.key_frames]
    assert min(keys) > 0.4 * max(keys)


def test_more_frames_than_their_length_says_are_refused() -> None:
    class Short(list):
        def __len__(self) -> int:
            return 2

    with pytest.raises(ValueError, match="as many as their length says, 2; got more"):
        fit_video(Short(SQUARES[:4]), num_gaussians=30, iterations=20, target_bytes=1500)


def test_a_budget_that_is_too_small_is_refused_at_once() -> None:
    with pytest.raises(ValueError, match=r"must allow \d{3} bytes for 4 frames; got 20"):
        fit_video(SQUARES[:4], kbps=1, **FEW)


def test_small_frames_have_as_many_gaussians_as_they_can() -> None:
    assert len(fit_video([smooth(0)[:, :8, :9]], iterations=10)[0]) <= 72


def test_a_clip_reads_on_after_it_was_interrupted(monkeypatch: pytest.MonkeyPatch) -> None:
    clip = fit_video(SQUARES[:4], MAPS[:4], num_gaussians=60, iterations=60)
    assert clip.key_frames == (0,)
    wanted = clip[3].render()
    again, whole = Clip.from_bytes(clip.to_bytes()), ClipPart.code
    assert len(again[1]) > 0

    def stop(*arguments: object) -> None:
        whole(*arguments)
        raise KeyboardInterrupt

    monkeypatch.setattr(ClipPart, "code", stop)
    with pytest.raises(KeyboardInterrupt):
        again[2]
    monkeypatch.undo()
    assert torch.equal(again[3].render(), wanted)


def test_a_frame_that_cannot_be_read_is_named() -> None:
    clip = fit_video(SQUARES[:3], MAPS[:3], num_gaussians=60, iterations=60)
    clip._records[2] = clip._records[2]._replace(data=b"\xff" * 40)
    with pytest.raises(CodecError, match="frame 2: "):
        Clip(clip._header, clip._records)[2]
