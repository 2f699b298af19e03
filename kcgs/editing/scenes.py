"""Move, delete and extract regions, or replace the background: each edit returns a new scene."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import torch

from kcgs._check import check_count
from kcgs.errors import InvalidArgument
from kcgs.maps import (
    RADIUS_SIGMAS,
    RegionMap,
    largest_softness,
    nearest_labels,
    softness_between,
    softness_of_map,
    touching_pairs,
)
from kcgs.nn import GaussianField, join, scaled_gaussians
from kcgs.scene import Scene, check_scene

from .fill import MARGIN, fill_hole
from .masks import check_offset, dilate, shift_labels
from .selection import (
    members_of,
    select_regions,
    select_regions_to_relabel,
    select_removable_regions,
    warn_of_lost_regions,
)


def move_region(
    scene: Scene,
    region_ids: int | Iterable[int],
    offset: Sequence[float],
    *,
    fill: bool = True,
    margin: int = MARGIN,
) -> Scene:
    """Move the Gaussians and labels of regions, over the regions at their new place.

    Convention: pixels that the regions leave take the label of the nearest pixel of another region. Pixels that leave
    the image are lost. A region that is fully covered, or leaves the image, is lost with its Gaussians. If pairs of
    regions differ in softness, a new contour has their mean softness. :func:`kcgs.video.move_in_video` moves regions in
    all frames of a video, and always fills the pixels that they leave.

    Args:
        scene: unbatched, with a map of its own size, not a resized one.
        region_ids: an id in the map, or several, which move together.
        offset: (dx, dy) in whole pixels.
        fill: True: uncovered pixels continue their surroundings with copies of other places; old and new Gaussians are
            fitted to these copies, and values beyond the margin change by a few hundredths. False: uncovered pixels
            show the Gaussians of their new region as they are: streaks or black.
        margin: pixels around the uncovered pixels that are filled too, at least 0: they have colours of the object,
            since contours are soft and masks are not exact.

    Returns:
        A new scene, without a graph.

    Raises:
        TypeError: wrong types.
        ValueError: a batch, no map or one of another size, an unknown id, all regions, an offset between pixels.

    Warns:
        UserWarning: regions are lost; it names their ids.

    Example:
        >>> labels = torch.tensor([[0, 7, 7, 0, 0, 0]])
        >>> scene = Scene(GaussianField.random(5, (1, 6), regions=labels, seed=0), labels)
        >>> move_region(scene, 7, (2, 0)).regions.labels
        tensor([[0, 0, 0, 7, 7, 0]])
    """
    selection = select_removable_regions(scene, region_ids)
    regions, hole = selection.regions, selection.pixels
    steps = check_offset(offset)
    check_count("margin", margin, 0)
    background_labels = nearest_labels(regions.labels, hole)
    landing, labels = shift_labels(regions.labels, hole, steps, background_labels)
    warn_of_lost_regions(regions, labels)
    field = scene.field
    if fill and (hole & ~landing).any():
        background = Scene(field.subset(~selection.members), regions.relabel(background_labels, "mean"))
        uncovered = dilate(~landing, _contour_reach(regions))
        filled = fill_hole(background, hole, hole & uncovered, margin)
        field = join(filled.field, field.subset(selection.members))
    field = field.subset(members_of(field, labels))
    with torch.no_grad():
        shift = field.means.new_tensor(steps)
        field.means += torch.where(members_of(field, selection.ids)[:, None], shift, 0.0)
    return Scene(field, regions.relabel(labels, "mean"), scene.metadata)


def _contour_reach(regions: RegionMap) -> int:
    """Return the distance from a contour, in pixels, within which the background of a region is visible."""
    return math.ceil(1.0 + RADIUS_SIGMAS * largest_softness(softness_of_map(regions.softness)))


def delete_region(scene: Scene, region_ids: int | Iterable[int], *, fill: bool = True, margin: int = MARGIN) -> Scene:
    """Delete regions with their Gaussians; their neighbours take over their pixels.

    Convention: each pixel of the regions takes the label of the nearest pixel of another region, and is filled.
    Arguments and errors are those of :func:`move_region`. If pairs of regions differ in softness, a new contour has
    their mean softness. :func:`kcgs.video.delete_from_video` deletes regions from all frames of a video, and always
    fills their pixels, from frames that show the background there.

    Example:
        >>> labels = torch.tensor([[0, 0, 3, 3, 3, 5]])
        >>> scene = Scene(GaussianField.random(9, (1, 6), regions=labels, seed=0), labels)
        >>> delete_region(scene, 3).regions.labels
        tensor([[0, 0, 0, 0, 5, 5]])
    """
    regions, _, hole, members = select_removable_regions(scene, region_ids)
    check_count("margin", margin, 0)
    labels = nearest_labels(regions.labels, hole)
    edited = Scene(scene.field.subset(~members), regions.relabel(labels, "mean"), scene.metadata)
    return fill_hole(edited, hole, hole, margin) if fill else edited


def extract_region(scene: Scene, region_ids: int | Iterable[int]) -> Scene:
    """Keep only the Gaussians of some regions: the new scene is black elsewhere.

    The map does not change, so that contours stay the same: `num_regions` counts the other regions too, and the repr of
    the scene says how many regions have no Gaussian. Arguments are those of :func:`move_region`; the map may be
    resized. :func:`render_region` renders regions with their membership as alpha.

    Example:
        >>> labels = torch.tensor([[0, 0, 3, 3, 3, 5]])
        >>> scene = Scene(GaussianField.random(9, (1, 6), regions=labels, seed=0), labels)
        >>> extract_region(scene, 3).field.region_ids.unique()
        tensor([3])
    """
    selection = select_regions(scene, region_ids)
    return Scene(scene.field.subset(selection.members), selection.regions, scene.metadata)


def replace_background(scene: Scene, region_ids: int | Iterable[int], background: Scene) -> Scene:
    """Put another scene, stretched to the size of this scene, in place of some regions.

    Convention: the regions of the background, or the background as one region, get ids above those of the scene.
    Contours keep their softness. If pairs of regions of the scene differ in softness, a new contour has their mean.

    Args:
        scene: unbatched, with a map of its own size, not a resized one.
        region_ids: the regions that the background replaces: an id in the map, or several.
        background: unbatched, with the same number of channels.

    Returns:
        A new scene, without a graph.

    Raises:
        TypeError, ValueError: as :func:`extract_region`; a resized map; another number of channels.

    Example:
        >>> labels = torch.tensor([[0, 0, 3, 3, 3, 5]])
        >>> scene = Scene(GaussianField.random(9, (1, 6), regions=labels, seed=0), labels)
        >>> other = Scene(GaussianField.random(4, (2, 12), seed=1))
        >>> replace_background(scene, [0, 5], other).regions.labels
        tensor([[6, 6, 3, 3, 3, 6]])
    """
    regions, _, pixels, members = select_regions_to_relabel(scene, region_ids)
    other, field = check_scene(background, "background").field, scene.field
    channels = field.colors.shape[-1]
    if other.colors.shape[-1] != channels:
        raise InvalidArgument("background", f"{channels} channels", other.colors.shape[-1], verb="have")
    first_id = int(regions.ids.max()) + 1
    background_labels = torch.full_like(regions.labels, first_id)
    ids = background_labels.new_full((other.num_gaussians,), first_id)
    background_map: RegionMap | None = None
    if background.regions is not None and other.region_ids is not None:
        background_map = background.regions.resize(scene.size)
        background_labels = background_map.labels.to(ids.device) + first_id
        ids = other.region_ids.to(ids.device) + first_id
    labels = torch.where(pixels, background_labels, regions.labels)
    new_map = _with_softness(regions.relabel(labels, "mean"), background_map, first_id)
    means, cholesky, colors = (t.to(field.means) for t in (*scaled_gaussians(other, scene.size), other.merged_colors()))
    new_field = join(field.subset(~members), GaussianField(means, cholesky, colors, ids, size=scene.size))
    return Scene(new_field.subset(members_of(new_field, labels)), new_map, scene.metadata)


def _with_softness(regions: RegionMap, background: RegionMap | None, first_id: int) -> RegionMap:
    """Give contours between ids from `first_id` on the softness of the background, whose ids begin at 0."""
    if background is None:
        return regions
    old, new = softness_of_map(regions.softness), softness_of_map(background.softness)
    if new == old:
        return regions
    pairs = {
        (a, b): softness_between(old, a, b) if a < first_id else softness_between(new, a - first_id, b - first_id)
        for a, b in touching_pairs(regions.labels)
    }
    return RegionMap(regions.labels, pairs)
