"""The frames of a video as one scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch

from kcgs.functional import RegionMap
from kcgs.nn import GaussianField
from kcgs.optim import Gaussians
from kcgs.scene import Scene


def stack(frames: Sequence[Scene], metadata: Mapping[str, str]) -> Scene:
    """Return the Gaussians and the maps of all frames as one scene."""
    rows = [Gaussians.of(frame.field) for frame in frames]
    means, cholesky, colors = (torch.stack(parts) for parts in zip(*(row[:3] for row in rows), strict=True))
    maps, size = [frame.regions for frame in frames if frame.regions is not None], frames[0].size
    if not maps:
        return Scene(GaussianField(means, cholesky, colors, size=size), None, metadata)
    region_ids = torch.stack([row.region_ids for row in rows if row.region_ids is not None])
    # a pair of regions has the same softness in all frames
    softness: dict[tuple[int, int], float] = {}
    for regions in maps:
        softness |= regions.softness if isinstance(regions.softness, Mapping) else {}
    labels = torch.stack([regions.labels for regions in maps])
    regions = RegionMap.from_labels(labels, softness or maps[0].softness)
    return Scene(GaussianField(means, cholesky, colors, region_ids, size=size), regions, metadata)
