"""Edits through time: functions of kcgs.editing take clips."""

from __future__ import annotations

import pytest
import torch

from kcgs import Clip, GaussianField, Scene, fit_video
from kcgs.editing import delete_region, move_region, recolor_region, replace_background


@pytest.fixture(scope="module")
def clip() -> Clip:
    """A bright bar that moves to the right; in the last frame it is gone."""
    column = torch.arange(48).expand(32, 48)
    maps = [((column >= 10 + 2 * k) & (column < 22 + 2 * k)).long() * 7 for k in range(3)] + [torch.zeros_like(column)]
    frames = [0.2 + 0.1 * labels.expand(3, 32, 48) for labels in maps]
    return fit_video(frames, maps, 40, frame_rate=10, iterations=30)


def test_frames_without_the_region_stay(clip: Clip) -> None:
    dark = recolor_region(clip, 7, 0.0)
    assert isinstance(dark, Clip) and len(dark) == 4 and dark.frame_rate == 10
    for number in range(3):
        assert float(clip[number].render()[:, 16, 16 + 2 * number].mean()) > 0.7
        assert float(dark[number].render()[:, 16, 16 + 2 * number].mean()) < 0.1
        assert (dark[number].render()[:, :, 40:] - clip[number].render()[:, :, 40:]).abs().max() < 0.05
    assert (dark[3].render() - clip[3].render()).abs().max() < 0.05


def test_edits_of_the_map(clip: Clip) -> None:
    moved = move_region(clip, [7], (4, 0), fill=None)
    gone = delete_region(clip, 7)
    behind = replace_background(clip, 0, Scene(GaussianField.random(9, (32, 48), seed=0)))
    for number in range(3):
        labels = moved[number].regions
        assert labels is not None and set(labels.labels[16, 15 + 2 * number : 25 + 2 * number].tolist()) == {7}
        assert gone[number].render().max() < 0.6
        both = behind[number].regions
        assert both is not None and set(both.ids.tolist()) == {7, 8}


def test_what_no_frame_has_is_refused(clip: Clip) -> None:
    with pytest.raises(ValueError, match="region_ids must be among the 2 ids of the Gaussians, 0, 7; got 3"):
        recolor_region(clip, 3, 0.5)
    with pytest.raises(ValueError, match="gain must have shape"):
        recolor_region(clip, 7, [1.0, 2.0])
