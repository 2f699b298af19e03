"""Label maps of the images of a fit."""

from __future__ import annotations

from collections.abc import Sequence

from kcgs.functional import RegionMap


def map_of_each(regions: RegionMap, count: int) -> list[RegionMap]:
    """Return the map of each of so many images: of a batch its own, else the one that all have."""
    return [map_of(regions, k) for k in range(count)]


def map_of(regions: RegionMap, image: int) -> RegionMap:
    """Return the map of an image: of a batch its own, else the one that all have."""
    return regions if regions.num_maps is None else regions[image]


def regions_per_map(regions: RegionMap) -> list[int]:
    """Return the number of regions of each map."""
    return [regions.num_regions] if regions.num_maps is None else [len(index.unique()) for index in regions.index]


def join_maps(maps: Sequence[RegionMap | None]) -> RegionMap | None:
    """Return the map of a batch from those of its images, each of one image or of the batch; None without maps."""
    first = maps[0]
    if all(one is first for one in maps):
        return first
    return RegionMap.stack([map_of(one, image) for image, one in enumerate(maps) if one is not None])
