"""Colours by least squares, which a picture is linear in."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcgs._check import check_cutoff, check_image
from kcgs.functional import RegionMap, region_splat
from kcgs.functional.splat import SCALE_LIMITS
from kcgs.nn import GaussianField


@torch.inference_mode(False)
@torch.enable_grad()
def solve_colors(
    field: GaussianField,
    image: Tensor,
    regions: RegionMap | None,
    *,
    steps: int = 20,
    cutoff: float = 1e-4,
    backend: str = "auto",
    damping: float = 1e-4,
) -> GaussianField:
    r"""Give the Gaussians the colours with the least squared error; centres and shapes stay.

    Convention: conjugate gradients from the present colours :math:`c^0` on :math:`|I - A c|^2 + \text{damping} \sum_i
    (a_i + \bar a) |c_i - c_i^0|^2`, :math:`a_i` the squared weights of Gaussian i summed over pixels and
    :math:`\bar a` their mean. The second term bounds the colours of near-duplicates and of the hardly seen (7,500
    Gaussians on a photograph: 1290 without it, 1.2 with it, the same 27.64 dB); it is zero at the start, so that any
    number of steps lowers the error.

    Args:
        field: Gaussians of one image; opacities are merged into the colours.
        image: :math:`(C, H, W)`, of the field's size, channels and device.
        regions: the map to draw with; None: one region.
        steps: at least 1; each costs a drawing and its backward.
        cutoff: weights below it are skipped.
        backend: as in :func:`kcgs.functional.region_splat`.
        damping: at least 0.

    Returns:
        A new field; `field` itself where the squared error did not fall, or rose once clipped to [0, 1].

    Raises:
        TypeError, ValueError: wrong types; a batched field; sizes, channels, devices that differ; numbers out of range.

    Example:
        >>> field = GaussianField.random(5, (16, 24), seed=0)
        >>> image = region_splat(field.means, field.cholesky, 1 - field.colors, size=field.size).detach()
        >>> torch.allclose(solve_colors(field, image, None, damping=0.0).colors, 1 - field.colors, atol=1e-4)
        True

    Source: Hestenes and Stiefel, "Methods of conjugate gradients for solving linear systems", 1952.
    """
    image = check_problem(field, image, regions, steps)
    if not 0.0 <= damping < math.inf:
        raise ValueError(f"damping must be finite and at least 0; got {damping!r}")
    scene = Drawing(field, regions, check_cutoff(cutoff), backend)
    start = field.merged_colors().detach().clone()
    residual = scene.gather(start, image)
    curvature = scene.squared_weights(start)
    holding = damping * (curvature + curvature.mean())
    scale = torch.where(curvature > 0, 1 / (curvature + holding), 0.0)
    change, direction = torch.zeros_like(start), scale * residual
    power = (residual * direction).double().sum(0)  # [C]: channels have nothing to do with each other
    for _ in range(steps):
        bent = scene.gather(direction, None) + holding * direction
        steepness = (direction * bent).double().sum(0)
        length = torch.where(steepness > 0, power / steepness, 0.0).to(start.dtype)
        change = change + length * direction
        residual = residual - length * bent
        ahead = scale * residual
        last, power = power, (residual * ahead).double().sum(0)
        direction = ahead + torch.where(last > 0, power / last, 0.0).to(start.dtype) * direction
    means, cholesky = field.means.detach(), field.cholesky.detach()
    solved = GaussianField(means, cholesky, start + change, field.region_ids, size=field.size)
    return solved if is_better(scene.draw(solved.colors), scene.draw(start), image) else field


class Drawing:
    """What is linear in the colours: A c, and A^T of an image by the backward of the drawing."""

    def __init__(self, field: GaussianField, regions: RegionMap | None, cutoff: float, backend: str) -> None:
        self.means, self.cholesky = field.means.detach().clone(), field.cholesky.detach().clone()
        self.where = None if regions is None else field.region_ids, regions
        self.size, self.cutoff, self.backend = field.size, cutoff, backend

    def draw(self, colors: Tensor) -> Tensor:
        """Return A c, (C, H, W)."""
        settings = {"size": self.size, "cutoff": self.cutoff, "backend": self.backend}
        return region_splat(self.means, self.cholesky, colors, *self.where, **settings)  # type: ignore[arg-type]

    def gather(self, colors: Tensor, image: Tensor | None) -> Tensor:
        """Return A^T (image - A c), or A^T A c where there is no image, (N, C)."""
        colors = colors.detach().requires_grad_()
        picture = self.draw(colors)
        against = picture.detach() if image is None else image - picture.detach()
        return torch.autograd.grad(picture, colors, against)[0]

    def squared_weights(self, colors: Tensor) -> Tensor:
        """Return s w^2 summed over pixels, (N, C): w^2 is a Gaussian of half the covariance."""
        own = self.cholesky, self.cutoff
        self.cholesky, self.cutoff = own[0] * math.sqrt(0.5), own[1] ** 2
        self.cholesky[:, ::2].clamp_(min=SCALE_LIMITS[0])
        colors = colors.detach().requires_grad_()
        picture = self.draw(colors)
        self.cholesky, self.cutoff = own
        return torch.autograd.grad(picture, colors, torch.ones_like(picture))[0]


def check_problem(field: GaussianField, image: Tensor, regions: RegionMap | None, steps: int) -> Tensor:
    """Return the image in the field's dtype, as a tensor that may take part in a graph."""
    if not isinstance(field, GaussianField):
        raise TypeError(f"field must be a GaussianField; got {type(field).__name__}")
    if field.means.ndim != 2 or len(field) == 0:
        raise ValueError(f"field must hold the Gaussians of one image; got means of shape {tuple(field.means.shape)}")
    image = check_image("image", image)
    if tuple(image.shape) != (field.colors.shape[-1], *field.size):
        raise ValueError(f"image must have shape {(field.colors.shape[-1], *field.size)}; got {tuple(image.shape)}")
    if image.device != field.means.device:
        raise ValueError(f"image must be on {field.means.device} with the field; got {image.device}")
    check_map(regions, field.size)
    if regions is not None and field.region_ids is None:
        raise ValueError("field must have region_ids where regions are given; call field.assign_regions(regions)")
    if isinstance(steps, bool) or not isinstance(steps, int) or steps < 1:
        raise ValueError(f"steps must be an integer of at least 1; got {steps!r}")
    return image.detach().to(field.means.dtype, copy=True)


def check_map(regions: RegionMap | None, size: tuple[int, int]) -> None:
    """Refuse what is not one map of this size."""
    if regions is not None and not isinstance(regions, RegionMap):
        raise TypeError(f"regions must be a RegionMap or None; got {type(regions).__name__}")
    if regions is not None and (regions.labels.ndim != 2 or regions.size != size):
        raise ValueError(f"regions must be one map of size {size}; got {tuple(regions.labels.shape)}")


def is_better(picture: Tensor, before: Tensor, image: Tensor) -> bool:
    """Say whether the squared error fell, and PSNR, which is taken on clipped images, did not."""
    clipped = [t.clamp(0.0, 1.0) for t in (picture, before, image)]
    (new, old), (new_seen, old_seen) = (
        [(t - target).double().square().sum() for t in both] for *both, target in ((picture, before, image), clipped)
    )
    return bool((new < old) & (new_seen <= old_seen))
