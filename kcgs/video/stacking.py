"""Stack the frames of a video into one scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch

from kcgs.maps import RegionMap
from kcgs.nn import GaussianField
from kcgs.scene import Scene


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
