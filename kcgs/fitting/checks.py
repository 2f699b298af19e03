"""The checks of images, label maps and numbers of Gaussians."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from kcgs._check import check_count
from kcgs._image import as_image
from kcgs.errors import InvalidArgument
from kcgs.maps import RegionMap, as_region_map

# pixels per Gaussian, where the user gives no number
_PIXELS_PER_GAUSSIAN = 100
# least number of Gaussians, where the user gives none
_LEAST_GAUSSIANS = 100


def check_image_and_regions(image: Any, regions: object) -> tuple[Tensor, RegionMap | None]:
    """Return a copy of the image, (C, H, W), that autograd accepts, and its regions on the image's device."""
    image = as_image("image", image)
    regions = regions_of(image.shape[1:], regions)
    if regions is not None:
        regions = regions.to(image.device)
    return _copy_of(image), regions


def check_images_and_regions(images: Any, regions: object, keep_batch: bool = True) -> tuple[Tensor, RegionMap | None]:
    """Return copies of the images, (B, C, H, W), and their regions: several images have a map each."""
    if not (keep_batch and is_batch(images)):
        image, region_map = check_image_and_regions(images, regions)
        return image[None], region_map
    images = as_image("image", images, keep_batch=True)
    region_map = regions_of(images.shape[2:], regions, len(images))
    if region_map is not None and region_map.num_maps is None and len(images) > 1:
        region_map = RegionMap.stack([region_map] * len(images))
    return _copy_of(images), None if region_map is None else region_map.to(images.device)


def is_batch(images: object) -> bool:
    """Whether images are a batch, (B, C, H, W)."""
    return isinstance(images, Tensor) and images.ndim == 4


def _copy_of(image: Tensor) -> Tensor:
    """Copy an image as float64 if it is float64, else as float32."""
    dtype = torch.float64 if image.dtype == torch.float64 else torch.float32
    return image.detach().to(dtype, copy=True, memory_format=torch.contiguous_format)


def regions_of(size: tuple[int, ...], regions: object, num_images: int | None = None) -> RegionMap | None:
    """Return a label map as a RegionMap of this size; a batch of images may have a map for each image."""
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


def default_num_gaussians(height: int, width: int) -> int:
    """Return the default N: one Gaussian per 100 pixels, at least 100, but at most the number of pixels."""
    pixels = height * width
    return min(pixels, max(_LEAST_GAUSSIANS, pixels // _PIXELS_PER_GAUSSIAN))


def check_num_gaussians(value: object, image: Tensor) -> int:
    """Validate N, from 1 to the pixels of an image (..., C, H, W); None gives the default."""
    height, width = image.shape[-2:]
    if value is None:
        return default_num_gaussians(height, width)
    count, pixels = check_count("num_gaussians", value), height * width
    if count > pixels:
        size = f"{width} x {height}"
        raise InvalidArgument("num_gaussians", f"at most {pixels}, the pixels of the {size} image", count)
    return count
