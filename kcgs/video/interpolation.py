"""Scenes between two frames."""

from __future__ import annotations

import math

import torch

from kcgs._check import check_number
from kcgs.editing import members_of
from kcgs.nn import GaussianField, join
from kcgs.scene import Scene, check_batch

from .flow import is_cut, move_image, move_labels, move_points, optical_flow, sample


@torch.no_grad()
def interpolate(scenes: Scene, time: float) -> Scene:
    """Return the scene at any time of a batch of scenes.

    Convention: between two frames the scene has the Gaussians of both, moved along the optical flow between their
    renders. The Gaussians of the earlier frame fade out while those of the later frame fade in. The label map is the
    moved map of the earlier frame.

    Args:
        scenes: T frames, as :func:`fit_video` returns them.
        time: in frames, 0 to T - 1.

    Returns:
        The frame itself for a whole `time`, the nearer frame at a scene cut, otherwise a scene of up to 2 N Gaussians.

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
    number, fraction = int(time), math.fmod(time, 1.0)
    if fraction == 0.0:
        return scenes[number]
    first, second = scenes[number], scenes[number + 1]
    previous, image = first.render(), second.render()
    flow = optical_flow(previous, image)
    if is_cut((move_image(flow, previous) - image).square(), image):
        return first if fraction < 0.5 else second
    earlier, later = first.field, second.field
    earlier_means = earlier.means.lerp(move_points(flow, earlier.means), fraction)
    later_means = later.means + (1 - fraction) * sample(flow, later.means)
    fading_out, fading_in = (1 - fraction) * earlier.merged_colors(), fraction * later.merged_colors()
    field = join(
        GaussianField(earlier_means, earlier.cholesky, fading_out, earlier.region_ids, size=scenes.size),
        GaussianField(later_means, later.cholesky, fading_in, later.region_ids, size=scenes.size),
    )
    if first.regions is None:
        return Scene(field, None, scenes.metadata)
    regions = first.regions.relabel(move_labels(fraction * flow, first.regions.labels))
    return Scene(field.subset(members_of(field, regions.ids)), regions, scenes.metadata)
