"""The checks of images, label maps and numbers of Gaussians."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from kcgs._check import check_count
from kcgs._image import as_image
from kcgs.errors import InvalidArgument
from kcgs.functional import RegionMap
from kcgs.maps import as_region_map


def check_image_and_regions(image: Any, regions: object) -> tuple[Tensor, RegionMap | None]:
    """Return a copy of the image, (C, H, W), that may take part in a graph, and its regions, on its device."""
    image = as_image("image", image)
    regions = regions_of(image.shape[1:], regions)
    if regions is not None:
        regions = regions.to(image.device)
    dtype = torch.float64 if image.dtype == torch.float64 else torch.float32
    return image.detach().to(dtype, copy=True, memory_format=torch.contiguous_format), regions


def regions_of(size: tuple[int, ...], regions: object, num_images: int | None = None) -> RegionMap | None:
    """Return a label map as one map of a size; for a batch of images there may be one for each."""
    regions = as_region_map(regions)
    if regions is None:
        return None
    if regions.num_maps == 1:
        regions = regions[0]
    if regions.size != tuple(size) or regions.num_maps not in (None, num_images):
        each = "" if num_images is None else f", or one for each of {num_images} images,"
        expected = f"one map{each} of the image's size {tuple(size)}"
        raise InvalidArgument("regions", expected, tuple(regions.labels.shape))
    return regions


def map_of_each(regions: RegionMap | None, count: int) -> list[RegionMap | None]:
    """Return the map of each of so many images: of a batch with their own regions, else the one that all have."""
    return [regions if regions is None or regions.num_maps is None else regions[k] for k in range(count)]


def check_num_gaussians(value: object, image: Tensor) -> int:
    """Return N if it is a number of Gaussians that an image (C, H, W) can use."""
    count, pixels = check_count("num_gaussians", value), image.shape[1] * image.shape[2]
    if count > pixels:
        size = f"{image.shape[2]} x {image.shape[1]}"
        raise InvalidArgument("num_gaussians", f"at most {pixels}, the pixels of the {size} image", count)
    return count
