"""The problem of a fit: an image, its regions, a number of Gaussians, and the settings."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from kcgs._check import check_count, check_size
from kcgs._image import as_image
from kcgs.errors import InvalidArgument
from kcgs.functional import RegionMap, edge_band
from kcgs.maps import as_region_map
from kcgs.optim import AbsoluteError, LossObjective, MsSsim, Objective, SquaredError

from .config import FitConfig
from .published.ssim_loss import AbsoluteAndSsim

_LOSSES = {"l1": AbsoluteError, "l2": SquaredError, "l1+ssim": AbsoluteAndSsim}
# share of an image's values that are 0 or 1 from which on `clamp="auto"` lets Gaussians overshoot them
_SATURATED_SHARE = 0.25


@dataclass(frozen=True)
class Problem:
    """What is to be fitted; nothing here changes during a fit."""

    image: Tensor
    """(C, H, W), in [0, 1]; NaN where there is none."""
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

    @property
    def has_own_loss(self) -> bool:
        """True where the objective is a function of the user's."""
        return callable(self.config.objective)

    @cached_property
    def has_image(self) -> bool:
        """True where there is an image."""
        return not bool(self.image.isnan().any())

    @cached_property
    def objective(self) -> Objective:
        """What the descent lowers."""
        if callable(self.config.objective):
            return LossObjective(self.config.objective, self.image, self.has_image)
        return MsSsim(self.image, self.reduction) if self.config.objective == "ms-ssim" else self.loss

    @cached_property
    def loss(self) -> Objective:
        """What the history calls loss."""
        return self.objective if self.has_own_loss else _LOSSES[self.config.loss](self.image)


def make_problem(
    image: Any,
    regions: object,
    num_gaussians: object,
    config: FitConfig,
    seed: object,
    size: tuple[int, int] | None = None,
    channels: int = 3,
) -> Problem:
    """Check the arguments of a fit."""
    if image is None and callable(config.objective):
        if size is None:
            raise InvalidArgument("size", "(height, width) without an image", None)
        if config.target_psnr is not None:
            raise InvalidArgument("target_psnr", "None without an image", config.target_psnr)
        # what needs an image: contours stay as they are
        update = {"move_contours": False, "merge_regions": False}
        config = config.model_copy(update=update | ({"softness": 0.0} if config.softness == "auto" else {}))
        image = torch.full((check_count("channels", channels), *check_size("size", size)), torch.nan)
        regions = regions_of(image.shape[1:], regions)
        image = image if regions is None else image.to(regions.ids.device)
    elif image is None and size is not None:
        raise InvalidArgument("image", "given, unless objective is a loss of your own", None)
    elif size is not None:
        raise InvalidArgument("size", "None with an image", size)
    else:
        image, regions = check_image_and_regions(image, regions)
    count = check_num_gaussians(num_gaussians, image)
    return Problem(image, regions, count, config, check_count("seed", seed, 0, 2**63 - 1))


def check_image_and_regions(image: Any, regions: object) -> tuple[Tensor, RegionMap | None]:
    """Return a copy of the image, (C, H, W), that may take part in a graph, and its regions, on its device."""
    image = as_image("image", image)
    regions = regions_of(image.shape[1:], regions)
    if regions is not None:
        regions = regions.to(image.device)
    dtype = torch.float64 if image.dtype == torch.float64 else torch.float32
    return image.detach().to(dtype, copy=True, memory_format=torch.contiguous_format), regions


def regions_of(size: tuple[int, ...], regions: object) -> RegionMap | None:
    """Return a label map as one map of a size."""
    regions = as_region_map(regions)
    if regions is None:
        return None
    if regions.num_maps == 1:
        regions = regions[0]
    if regions.size != tuple(size) or regions.num_maps is not None:
        raise InvalidArgument("regions", f"one map of the image's size {tuple(size)}", tuple(regions.labels.shape))
    return regions


def check_num_gaussians(value: object, image: Tensor) -> int:
    """Return N if it is a number of Gaussians that an image (C, H, W) can use."""
    count, pixels = check_count("num_gaussians", value), image.shape[1] * image.shape[2]
    if count > pixels:
        size = f"{image.shape[2]} x {image.shape[1]}"
        raise InvalidArgument("num_gaussians", f"at most {pixels}, the pixels of the {size} image", count)
    return count
