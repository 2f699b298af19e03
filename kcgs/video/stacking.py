"""Stack the frames of a video into one scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch

from kcgs.functional import RegionMap
from kcgs.nn import GaussianField
from kcgs.optim import Gaussians
from kcgs.scene import Scene


def clear_lost_rows(gaussians: Gaussians, regions: RegionMap) -> Gaussians:
    """Make the rows of regions that a map lacks unused: they get the colour 0 and a region of the map."""
    means, cholesky, colors, region_ids = gaussians
    if region_ids is None:
        return gaussians
    is_present = torch.isin(region_ids, regions.ids)
    region_ids = torch.where(is_present, region_ids, regions.ids[0])
    return Gaussians(means, cholesky, torch.where(is_present[..., None], colors, 0.0), region_ids)


def stack(frames: Sequence[Scene], metadata: Mapping[str, str]) -> Scene:
    """Stack the Gaussians and the maps of all frames into one scene."""
    field = GaussianField.stack([frame.field for frame in frames])
    maps = [frame.regions for frame in frames if frame.regions is not None]
    if not maps:
        return Scene(field, None, metadata)
    # a pair of regions has the same softness in all frames
    softness: dict[tuple[int, int], float] = {}
    for regions in maps:
        softness |= regions.softness if isinstance(regions.softness, Mapping) else {}
    labels = torch.stack([regions.labels for regions in maps])
    regions = RegionMap(labels, softness or maps[0].softness)
    return Scene(field, regions, metadata)
