"""The problem of a fit: an image, its regions, a number of Gaussians, and the settings."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from kcgs._check import check_count, check_size
from kcgs._objectives import Purpose, objective_for
from kcgs.errors import InvalidArgument
from kcgs.functional import RegionMap, edge_band
from kcgs.optim import OBJECTIVES, ImageObjective, LossObjective, MsSsim, Objective

from .checks import check_image_and_regions, check_num_gaussians, regions_of
from .config import FitConfig
from .published.ssim_loss import AbsoluteAndSsim
from .user_objects import NO_OBJECTS, UserObjects

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
    """Its objective is a name, unless `objects` has one."""
    seed: int
    objects: UserObjects = NO_OBJECTS
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
        return self.canvas.shape[-2], self.canvas.shape[-1]

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
        """Image, row and column (M, 3) of the pixels near a contour of the user's map, for EF-PSNR."""
        mask = self.band_mask
        if mask is None:
            return torch.empty(0, 3, dtype=torch.int64, device=self.device)
        return mask.reshape(-1, *self.size).nonzero().contiguous()

    @cached_property
    def band_mask(self) -> Tensor | None:
        """The same pixels as a mask, (..., 1, H, W); None without a map."""
        return None if self.regions is None else edge_band(self.regions.labels).unsqueeze(-3)

    @property
    def num_excess_regions(self) -> int:
        """Regions beyond the number of Gaussians, which are merged or stay black; 0 without guidance."""
        if self.regions is None or not self.config.guidance:
            return 0
        return max(0, self.regions.num_regions - self.num_gaussians)

    @property
    def chooses_softness(self) -> bool:
        """True where the softness of contours is to be chosen, and the map came without."""
        return self.config.softness == "auto" and self.regions is not None and self.regions.softness == 0.0

    @cached_property
    def objective(self) -> Objective:
        """What the descent lowers."""
        if self.objects.objective is not None:
            return LossObjective(self.objects.objective, self.image)
        assert self.config.objective is not None
        kind = _OBJECTIVES[self.config.objective]
        return MsSsim(self.canvas, self.reduction) if kind is MsSsim else kind(self.canvas)


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
        config = config.model_copy(update={"objective": objective_for(purpose, config.objective)})
    has_image = image is not None
    if image is None and objects.objective is not None:
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
    return Problem(canvas, region_map, count, config, check_count("seed", seed, 0, 2**63 - 1), objects, has_image)
