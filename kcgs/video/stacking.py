"""Stack the frames of a video into one scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch

from kcgs.maps import GivenSoftness, PairSoftness, RegionMap, softness_of_map, touching_pairs
from kcgs.nn import GaussianField
from kcgs.scene import Scene


def stack(frames: Sequence[Scene], metadata: Mapping[str, str]) -> Scene:
    """Stack the Gaussians and the maps of all frames into one scene."""
    field = GaussianField.stack([frame.field for frame in frames])
    maps = [frame.regions for frame in frames if frame.regions is not None]
    if not maps:
        return Scene(field, None, metadata)
    labels = torch.stack([regions.labels for regions in maps])
    return Scene(field, RegionMap(labels, _softness_of_all(maps)), metadata)


def _softness_of_all(maps: Sequence[RegionMap]) -> GivenSoftness:
    """Return the softness of all frames: a pair of regions has the same one in each frame in which it touches."""
    softness = [softness_of_map(regions.softness) for regions in maps]
    if not any(isinstance(one, PairSoftness) for one in softness):
        return softness[0]
    pairs: dict[tuple[int, int], float] = {}
    for one, regions in zip(softness, maps, strict=True):
        pairs |= one if isinstance(one, PairSoftness) else dict.fromkeys(touching_pairs(regions.labels), one)
    return pairs
