"""Frames between two frames."""

from __future__ import annotations

import math

import torch

from kcgs._check import check_number
from kcgs.editing.selection import members_of
from kcgs.nn import GaussianField
from kcgs.nn.field import join
from kcgs.scene import Scene, check_batch

from .motion import estimate_motion, motion_at, move_labels, move_points


@torch.no_grad()
def interpolate(scenes: Scene, time: float) -> Scene:
    """Return the scene at any time of a batch of scenes.

    Convention: between two frames there are the Gaussians of both, moved along the motion between their renders; those
    of the earlier fade out while those of the later fade in. So a relocated row needs no rule of its own. The label map
    is that of the earlier frame, moved.

    Args:
        scenes: T frames, as :func:`fit_video` gives them.
        time: in frames, 0 to T - 1.

    Returns:
        The frame itself for a whole `time`; otherwise a scene of up to 2 N Gaussians.

    Raises:
        TypeError: a scene of one image.
        ValueError: a time out of range.

    Example:
        >>> means = torch.tensor([[[3.0, 4.0]], [[5.0, 4.0]]])
        >>> field = GaussianField(means, torch.ones(2, 1, 3), torch.ones(2, 1, 3), size=(8, 8))
        >>> interpolate(Scene(field), 0.5).num_gaussians
        2
    """
    time = check_number("time", time, 0.0, len(check_batch(scenes)) - 1.0, unit="frames")
    number, share = int(time), math.fmod(time, 1.0)
    if share == 0.0:
        return scenes[number]
    first, second = scenes[number], scenes[number + 1]
    motion = estimate_motion(first.render(), second.render())
    one, other = first.field, second.field
    earlier = one.means.lerp(move_points(motion, one.means), share)
    later = other.means + (1 - share) * motion_at(motion, other.means)
    field = join(
        GaussianField(earlier, one.cholesky, (1 - share) * one.merged_colors(), one.region_ids, size=scenes.size),
        GaussianField(later, other.cholesky, share * other.merged_colors(), other.region_ids, size=scenes.size),
    )
    if first.regions is None:
        return Scene(field, None, scenes.metadata)
    regions = first.regions.relabel(move_labels(share * motion, first.regions.labels))
    return Scene(field.subset(members_of(field, regions.ids)), regions, scenes.metadata)
