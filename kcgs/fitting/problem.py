"""The problem of a fit: an image, its regions, a number of Gaussians, and the settings."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from kcgs._check import check_count, check_size
from kcgs._image import as_image
from kcgs._objectives import Purpose, objective_for
from kcgs.errors import InvalidArgument
from kcgs.functional import RegionMap, edge_band
from kcgs.maps import as_region_map
from kcgs.optim import OBJECTIVES, ImageObjective, LossObjective, MsSsim, Objective

from .config import FitConfig
from .custom import NONE, Custom
from .published.ssim_loss import AbsoluteAndSsim

_OBJECTIVES: dict[str, type[ImageObjective]] = {**OBJECTIVES, "l1+ssim": AbsoluteAndSsim}
# of every value, where there is no image
_GREY = 0.5
# share of an image's values that are 0 or 1 from which on `clamp="auto"` lets Gaussians overshoot them
_SATURATED_SHARE = 0.25


@dataclass(frozen=True)
class Problem:
    """What is to be fitted; nothing here changes during a fit."""

    canvas: Tensor
    """(C, H, W), in [0, 1]: the image, or grey of the size of the render, which the first Gaussians show."""
    regions: RegionMap | None
    """The map as the user gave it."""
    num_gaussians: int
    """N, the most that the result may have."""
    config: FitConfig
    """Its objective is a name, unless `custom` has one."""
    seed: int
    custom: Custom = NONE
    has_image: bool = True
    """False: only the objective says what is wanted."""
    reduction: int = 1
    """Factor by which the sides of a photo were reduced to those of the image."""

    @property
    def image(self) -> Tensor | None:
        """The image, (C, H, W), if there is one."""
        return self.canvas if self.has_image else None

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of the render."""
        return self.canvas.shape[1], self.canvas.shape[2]

    @property
    def device(self) -> torch.device:
        """Where the fit is computed."""
        return self.canvas.device

    @cached_property
    def bounds(self) -> tuple[Tensor, Tensor] | None:
        """The values to which the render is clipped in training, if it is: two tensors (C, H, W), or scalars.

        A clipped value has no gradient, even where it is wrong. So `clamp="auto"` clips at 0 only where the image is 0,
        and at 1 only where it is 1.
        """
        if self.config.clamp == "auto":
            black, white = self.canvas == 0.0, self.canvas == 1.0
            if float((black | white).float().mean()) < _SATURATED_SHARE:
                return None
            return torch.where(black, 0.0, -torch.inf), torch.where(white, 1.0, torch.inf)
        return (self.canvas.new_zeros(()), self.canvas.new_ones(())) if self.config.clamp else None

    @cached_property
    def band(self) -> Tensor:
        """Rows and columns (M, 2) of the pixels near a contour of the user's map, for EF-PSNR."""
        if self.regions is None:
            return torch.empty(0, 2, dtype=torch.int64, device=self.device)
        return edge_band(self.regions.labels).nonzero().contiguous()

    @property
    def chooses_softness(self) -> bool:
        """True where the softness of contours is to be chosen, and the map came without."""
        return self.config.softness == "auto" and self.regions is not None and self.regions.softness == 0.0

    @cached_property
    def objective(self) -> Objective:
        """What the descent lowers."""
        if self.custom.objective is not None:
            return LossObjective(self.custom.objective, self.image)
        assert self.config.objective is not None
        kind = _OBJECTIVES[self.config.objective]
        return MsSsim(self.canvas, self.reduction) if kind is MsSsim else kind(self.canvas)


def make_problem(
    image: Any,
    regions: object,
    num_gaussians: object,
    config: FitConfig,
    seed: object,
    custom: Custom = NONE,
    *,
    purpose: Purpose = "fit",
    size: tuple[int, int] | None = None,
    channels: int = 3,
) -> Problem:
    """Check the arguments of a fit for a purpose."""
    if custom.objective is None:
        config = config.model_copy(update={"objective": objective_for(purpose, config.objective)})
    has_image = image is not None
    if image is None and custom.objective is not None:
        if size is None:
            raise InvalidArgument("size", "(height, width) without an image", None)
        if config.target_psnr is not None:
            raise InvalidArgument("target_psnr", "None without an image", config.target_psnr)
        # what needs an image: contours stay as they are
        update = {"move_contours": False, "merge_regions": False}
        config = config.model_copy(update=update | ({"softness": 0.0} if config.softness == "auto" else {}))
        canvas = torch.full((check_count("channels", channels), *check_size("size", size)), _GREY)
        region_map = regions_of(canvas.shape[1:], regions)
        canvas = canvas if region_map is None else canvas.to(region_map.ids.device)
    elif image is None and size is not None:
        raise InvalidArgument("image", "given, unless objective is a loss of your own", None)
    elif size is not None:
        raise InvalidArgument("size", "None with an image", size)
    else:
        canvas, region_map = check_image_and_regions(image, regions)
    count = check_num_gaussians(num_gaussians, canvas)
    return Problem(canvas, region_map, count, config, check_count("seed", seed, 0, 2**63 - 1), custom, has_image)


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
