"""The problem of a fit: an image, its regions, a number of Gaussians, and the settings."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from kcgs._check import check_count
from kcgs._image import as_image
from kcgs.errors import InvalidArgument
from kcgs.functional import RegionMap, edge_band
from kcgs.maps import as_region_map

from .config import FitConfig
from .objective import MsSsimObjective, make_objective

# share of an image's values that are 0 or 1 from which on `clamp="auto"` lets Gaussians overshoot them
_SATURATED_SHARE = 0.25


@dataclass(frozen=True)
class Problem:
    """What is to be fitted; nothing here changes during a fit."""

    image: Tensor
    """(C, H, W), in [0, 1]."""
    regions: RegionMap | None
    """The map as the user gave it."""
    num_gaussians: int
    """N, the most that the result may have."""
    config: FitConfig
    seed: int
    reduction: int = 1
    """Factor by which the sides of a photo were reduced to those of the image."""

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of the image."""
        return self.image.shape[1], self.image.shape[2]

    @cached_property
    def bounds(self) -> tuple[Tensor, Tensor] | None:
        """The values to which the render is clipped in training, if it is: two tensors (C, H, W), or scalars.

        A clipped value has no gradient, even where it is wrong. So `clamp="auto"` clips at 0 only where the image is 0,
        and at 1 only where it is 1.
        """
        if self.config.clamp == "auto":
            black, white = self.image == 0.0, self.image == 1.0
            if float((black | white).float().mean()) < _SATURATED_SHARE:
                return None
            return torch.where(black, 0.0, -torch.inf), torch.where(white, 1.0, torch.inf)
        return (self.image.new_zeros(()), self.image.new_ones(())) if self.config.clamp else None

    @cached_property
    def band(self) -> Tensor:
        """Rows and columns (M, 2) of the pixels near a contour of the user's map, for EF-PSNR."""
        if self.regions is None:
            return torch.empty(0, 2, dtype=torch.int64, device=self.image.device)
        return edge_band(self.regions.labels).nonzero().contiguous()

    @property
    def chooses_softness(self) -> bool:
        """True where the softness of contours is to be chosen, and the map came without."""
        return self.config.softness == "auto" and self.regions is not None and self.regions.softness == 0.0

    @cached_property
    def objective(self) -> MsSsimObjective | None:
        """What the descent lowers; None: what the setting `loss` says."""
        return make_objective(self.config.objective, self.image, self.reduction)


def make_problem(image: Any, regions: object, num_gaussians: object, config: FitConfig, seed: object) -> Problem:
    """Check the arguments of a fit."""
    image, regions = check_image_and_regions(image, regions)
    count = check_num_gaussians(num_gaussians, image)
    return Problem(image, regions, count, config, check_count("seed", seed, 0, 2**63 - 1))


def check_image_and_regions(image: Any, regions: object) -> tuple[Tensor, RegionMap | None]:
    """Return a copy of the image, (C, H, W), that may take part in a graph, and its regions, on its device."""
    image = as_image("image", image)
    regions = as_region_map(regions)
    if regions is not None:
        if regions.num_maps == 1:
            regions = regions.image(0)
        if regions.size != tuple(image.shape[1:]) or regions.num_maps is not None:
            expected = f"one map of the image's size {tuple(image.shape[1:])}"
            raise InvalidArgument("regions", expected, tuple(regions.labels.shape))
        regions = regions.to(image.device)
    dtype = torch.float64 if image.dtype == torch.float64 else torch.float32
    return image.detach().to(dtype, copy=True, memory_format=torch.contiguous_format), regions


def check_num_gaussians(value: object, image: Tensor) -> int:
    """Return N if it is a number of Gaussians that an image (C, H, W) can use."""
    count, pixels = check_count("num_gaussians", value), image.shape[1] * image.shape[2]
    if count > pixels:
        size = f"{image.shape[2]} x {image.shape[1]}"
        raise InvalidArgument("num_gaussians", f"at most {pixels}, the pixels of the {size} image", count)
    return count
