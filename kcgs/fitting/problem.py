"""The problem of a fit: images, their regions, a number of Gaussians, and the settings."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from kcgs._check import check_count, check_size
from kcgs._memory import check_batch_memory
from kcgs._objectives import Purpose
from kcgs.errors import InvalidArgument
from kcgs.maps import RegionMap, edge_band, softness_of_map
from kcgs.optim import OBJECTIVES, ImageObjective, LossObjective, Objective

from .checks import check_images_and_regions, check_num_gaussians, is_batch, regions_of
from .config import FitConfig, config_for
from .image_maps import regions_per_map
from .user_objects import NO_OBJECTS, UserObjects

# value of the target where there is no image
_GREY = 0.5
# peak memory of a fit in bytes, measured: for each pixel, for each value of an image, and for each Gaussian
_BYTES_PER_PIXEL = 50
_BYTES_PER_VALUE = 50
_BYTES_PER_GAUSSIAN = 1000
# `clamp="auto"` clips the render where an image is 0 or 1, if at least this share of its values are
_SATURATED_SHARE = 0.25


@dataclass(frozen=True)
class Problem:
    """The checked arguments of a fit; nothing here changes during a fit."""

    target: Tensor
    """The images, (B, C, H, W), in [0, 1]; without images, grey of the size of the render."""
    regions: RegionMap | None
    """The user's map; several images have a map each."""
    num_gaussians: int
    """N, the most Gaussians of each image in the result."""
    config: FitConfig
    """Its objective is a name, unless `objects` has an objective."""
    seed: int
    objects: UserObjects = NO_OBJECTS
    has_image: bool = True
    """False: there is only the objective, and no image to compare with."""
    is_batch: bool = False
    """True if the user passed a batch, also of one image: the result is then a batch."""
    reduction: int = 1
    """Factor by which the sides of a photo were reduced to those of the image."""

    @property
    def image(self) -> Tensor | None:
        """The images, (B, C, H, W); None if there are none."""
        return self.target if self.has_image else None

    @property
    def num_images(self) -> int:
        """The number of images, B."""
        return len(self.target)

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of the render."""
        return self.target.shape[-2], self.target.shape[-1]

    @property
    def device(self) -> torch.device:
        """The device of the fit."""
        return self.target.device

    @cached_property
    def bounds(self) -> tuple[Tensor, Tensor] | None:
        """Lower and upper bounds of the render in training, two tensors (B, C, H, W) or scalars; None: no clipping.

        A clipped value has no gradient, even where it is wrong. So `clamp="auto"` clips at 0 only where an image is 0,
        and at 1 only where it is 1.
        """
        if self.config.clamp == "auto":
            black, white = self.target == 0.0, self.target == 1.0
            is_saturated = (black | white).float().mean((1, 2, 3), keepdim=True) >= _SATURATED_SHARE
            if not bool(is_saturated.any()):
                return None
            low = torch.where(black & is_saturated, 0.0, -torch.inf)
            return low, torch.where(white & is_saturated, 1.0, torch.inf)
        return (self.target.new_zeros(()), self.target.new_ones(())) if self.config.clamp else None

    @cached_property
    def band(self) -> Tensor:
        """Image, row and column, (M, 3), of the pixels near a contour of the user's map, for EF-PSNR."""
        mask = self.band_mask
        if mask is None:
            return torch.empty(0, 3, dtype=torch.int64, device=self.device)
        return mask.reshape(-1, *self.size).nonzero().contiguous()

    @cached_property
    def band_mask(self) -> Tensor | None:
        """The pixels of `band` as a mask, (..., 1, H, W); None without a map."""
        return None if self.regions is None else edge_band(self.regions.labels).unsqueeze(-3)

    @cached_property
    def num_excess_regions(self) -> int:
        """Number of regions, in all images, that are merged or stay black as N is too small; 0 without guidance."""
        if self.regions is None or not self.config.guidance:
            return 0
        return sum(max(0, count - self.num_gaussians) for count in regions_per_map(self.regions))

    def chooses_softness(self, image: int) -> bool:
        """Whether the fit chooses the softness of an image's contours: the setting is auto, and the map has none."""
        softness = None if self.regions is None else softness_of_map(self.regions.softness, image)
        return self.config.softness == "auto" and softness == 0.0

    @cached_property
    def objective(self) -> Objective:
        """The objective that the descent lowers."""
        if self.objects.objective is not None:
            return LossObjective(self.objects.objective, self.image)
        return self.make_objective(self.target)

    def make_objective(self, image: Tensor) -> ImageObjective:
        """Return the objective of the settings for an image, (..., C, H, W)."""
        assert self.config.objective is not None
        return OBJECTIVES[self.config.objective](image, self.reduction)


def make_problem(
    image: Any,
    regions: object,
    num_gaussians: object,
    config: FitConfig,
    seed: object,
    objects: UserObjects = NO_OBJECTS,
    *,
    purpose: Purpose = "fit",
    size: tuple[int, int] | None = None,
    channels: int = 3,
) -> Problem:
    """Check the arguments of a fit for a purpose."""
    if objects.objective is None:
        config = config_for(purpose, config)
    if config.bounded and objects.optimizer is not None:
        raise InvalidArgument("bounded", "False with an optimizer of your own", True)
    has_image = image is not None
    if not has_image and objects.objective is not None:
        if size is None:
            raise InvalidArgument("size", "(height, width) without an image", None)
        config = _without_image(config)
        target = torch.full((1, check_count("channels", channels), *check_size("size", size)), _GREY)
        region_map = regions_of(target.shape[2:], regions)
        target = target if region_map is None else target.to(region_map.ids.device)
    elif size is not None:
        if not has_image:
            raise InvalidArgument("image", "given, unless objective is a loss of your own", None)
        raise InvalidArgument("size", "None with an image", size)
    else:
        target, region_map = check_images_and_regions(image, regions, keep_batch=purpose == "fit")
    count, seed = check_num_gaussians(num_gaussians, target), check_count("seed", seed, 0, 2**63 - 1)
    problem = Problem(target, region_map, count, config, seed, objects, has_image, is_batch(image) and purpose == "fit")
    if problem.num_images > 1:
        _check_batch(problem)
    return problem


def _without_image(config: FitConfig) -> FitConfig:
    """Return the settings of a fit without an image: contours stay, regions are not merged, softness is not chosen."""
    if config.target_psnr is not None:
        raise InvalidArgument("target_psnr", "None without an image", config.target_psnr)
    softness = 0.0 if config.softness == "auto" else config.softness
    return config.model_copy(update={"move_contours": False, "merge_regions": False, "softness": softness})


def _check_batch(problem: Problem) -> None:
    """Refuse settings that take one image at a time, and batches that do not fit into memory."""
    count, channels, height, width = problem.target.shape
    for name, expected, value in (
        ("target_psnr", "None", problem.config.target_psnr),
        ("objective", "a name", problem.objects.objective),
    ):
        if value is not None:
            raise InvalidArgument(name, f"{expected} with {count} images: fit them one by one", repr(value))
    bytes_of_image = height * width * (_BYTES_PER_PIXEL + channels * _BYTES_PER_VALUE)
    check_batch_memory("image", problem.target, bytes_of_image + problem.num_gaussians * _BYTES_PER_GAUSSIAN)
