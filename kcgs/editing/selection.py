"""The regions of a scene that an edit acts on."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from kcgs._check import check_count
from kcgs._warn import warn_user
from kcgs.errors import InvalidArgument
from kcgs.maps import RegionMap
from kcgs.nn import GaussianField
from kcgs.scene import Scene, check_scene, check_type


class Selection(NamedTuple):
    """Selected regions of a scene."""

    regions: RegionMap
    """The map of the scene."""
    ids: Tensor
    """The ids of the selection, sorted, without duplicates."""
    pixels: Tensor
    """Mask of the pixels of the selection, :math:`(H, W)` bool."""
    members: Tensor
    """Mask of the Gaussians of the selection, :math:`(N,)` bool."""


def select_regions(scene: Scene, region_ids: object) -> Selection:
    """Select regions of a scene of one image, which must have a map."""
    regions = check_scene(scene).regions
    if regions is None:
        raise InvalidArgument("scene", "a label map", "none: small files have none", verb="have")
    ids = torch.tensor(unique_region_ids(region_ids, regions.ids, "map"), device=regions.ids.device)
    return Selection(regions, ids, torch.isin(regions.labels, ids), members_of(scene.field, ids))


def select_regions_to_relabel(scene: Scene, region_ids: object) -> Selection:
    """Select regions of a map whose labels are those of its contours: a resized map has finer contours."""
    selection = select_regions(scene, region_ids)
    if selection.regions.is_resampled:
        raise ValueError("scene must not have a resized map: edit the map at its own size, then resize it")
    return selection


def select_removable_regions(scene: Scene, region_ids: object) -> Selection:
    """Select regions whose pixels other regions of the map can take over."""
    if (count := check_type(scene).num_images) is not None:
        advice = "scene[t] is one of them, and kcgs.video edits regions in all of them"
        raise InvalidArgument("scene", "of one image", f"a batch of {count}: {advice}")
    selection = select_regions_to_relabel(scene, region_ids)
    if selection.regions.num_regions == len(selection.ids):
        received = f"all {len(selection.ids)} regions"
        raise InvalidArgument("region_ids", "a region that takes over pixels", received, verb="leave")
    return selection


def unique_region_ids(region_ids: object, known: Tensor, owner: str) -> list[int]:
    """Return one or several ids as a sorted list without duplicates, if all are among the owner's `known` ids."""
    has_one = getattr(region_ids, "ndim", 1) == 0  # such as labels[y, x]: it has the method __iter__, too
    sequence = region_ids if isinstance(region_ids, Iterable) and not has_one else [region_ids]
    ids = sorted({check_count("region_ids", region, 0) for region in sequence})
    if not ids:
        raise InvalidArgument("region_ids", "an id", "none", verb="hold")
    known_ids = known.unique().tolist()
    for region in ids:
        if region not in known_ids:
            listed = ", ".join(map(str, known_ids[:20])) + (" ..." if len(known_ids) > 20 else "")
            raise InvalidArgument("region_ids", f"among the {len(known_ids)} ids of the {owner}, {listed}", region)
    return ids


def members_of(field: GaussianField, ids: Tensor) -> Tensor:
    """Return the mask of the Gaussians that belong to some regions, (..., N) bool."""
    assert field.region_ids is not None
    return torch.isin(field.region_ids, ids)


def warn_of_lost_regions(regions: RegionMap, labels: Tensor) -> None:
    """Warn of regions that are no longer in the labels, of one image or of all frames."""
    if lost_ids := regions.ids[~torch.isin(regions.ids, labels)].tolist():
        warn_user(f"regions {', '.join(map(str, lost_ids))} are lost: covered, or out of the image")
