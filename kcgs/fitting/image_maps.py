"""The maps of a fit's images: None, one RegionMap that all images share, or a batch with a map for each image.

What goes image by image reads one map at a time by `map_of`, and joins them again by `join_maps`. A batch may stand for
the map at an image's index, since a slice at every measurement would be a copy.
"""

from __future__ import annotations

from collections.abc import Sequence

from kcgs.maps import RegionMap


def map_of(regions: RegionMap, image: int) -> RegionMap:
    """Return the map of an image: its own map from a batch, else the map that all images share."""
    return regions if regions.num_maps is None else regions[image]


def map_of_each(regions: RegionMap, count: int) -> list[RegionMap]:
    """Return a map for each of `count` images, as `map_of` does."""
    return [map_of(regions, k) for k in range(count)]


def regions_per_map(regions: RegionMap) -> list[int]:
    """Return the number of regions of each map."""
    return [regions.num_regions] if regions.num_maps is None else [len(index.unique()) for index in regions.index]


def join_maps(maps: Sequence[RegionMap | None]) -> RegionMap | None:
    """Join a map for each image of a batch; of a batch of maps, the map at the image's index. None without maps."""
    first = maps[0]
    if all(one is first for one in maps):
        return first
    return RegionMap.stack([map_of(one, image) for image, one in enumerate(maps) if one is not None])
