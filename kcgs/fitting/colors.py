"""Colours by least squares, which a render is linear in."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcgs.functional import RegionMap, region_splat
from kcgs.kernels.whitened import SCALE_LIMITS
from kcgs.nn import GaussianField
from kcgs.scene import Scene

from .conjugate_gradients import conjugate_gradients


def solve_colors(
    scene: Scene, image: Tensor, *, steps: int = 20, cutoff: float = 1e-4, backend: str = "auto", damping: float = 1e-4
) -> Scene:
    r"""Give the Gaussians the colours with the least squared error; return the scene itself where it did not fall.

    Conjugate gradients from the present colours :math:`c^0` on :math:`|I - A c|^2 + \text{damping} \sum_i
    (a_i + \bar a) |c_i - c_i^0|^2`, :math:`a_i` the squared weights of Gaussian i summed over pixels and
    :math:`\bar a` their mean. The second term bounds the colours of near-duplicates and of the hardly seen (7,500
    Gaussians on a photograph: 1290 without it, 1.2 with it, the same 27.64 dB).
    """
    field, regions = scene.field, scene.regions
    start = field.merged_colors().detach().clone()
    means, cholesky = field.means.detach(), field.cholesky.detach()
    operator = ColorOperator(field, regions, start, cutoff, backend)
    # w^2 is a Gaussian of half the covariance
    narrow = cholesky * math.sqrt(0.5)
    narrow[:, ::2].clamp_(min=SCALE_LIMITS[0])
    squares = GaussianField(means, narrow, start, field.region_ids, size=field.size)
    curvature = ColorOperator(squares, regions, start, cutoff**2, backend).adjoint(torch.ones_like(image))
    holding = damping * (curvature + curvature.mean())
    scale = torch.where(curvature > 0, 1 / (curvature + holding), 0.0)
    before = operator.rendered.detach()
    change = conjugate_gradients(
        torch.zeros_like(start),
        operator.adjoint(image - before),
        lambda p: operator.adjoint(operator.render(p)) + holding * p,
        steps,
        gradient=lambda r: scale * r,
        # channels have nothing to do with each other
        dot=lambda a, b: (a * b).double().sum(0),
    )
    colors = start + change
    if not is_better(operator.render(colors), before, image):
        return scene
    return Scene(GaussianField(means, cholesky, colors, field.region_ids, size=field.size), regions, scene.metadata)


class ColorOperator:
    """What is linear in the colours: A c, and the transpose of A by the backward of a render of `colors`."""

    def __init__(
        self, field: GaussianField, regions: RegionMap | None, colors: Tensor, cutoff: float, backend: str
    ) -> None:
        self._geometry = field.means.detach(), field.cholesky.detach()
        self._confined = None if regions is None else field.region_ids, regions
        self._settings = {"size": field.size, "cutoff": cutoff, "backend": backend}
        with torch.enable_grad():
            self._leaf = colors.detach().requires_grad_()
            self.rendered = self.render(self._leaf)

    def render(self, colors: Tensor) -> Tensor:
        """Return A c, (C, H, W)."""
        return region_splat(*self._geometry, colors, *self._confined, **self._settings)  # type: ignore[arg-type]

    def adjoint(self, image: Tensor) -> Tensor:
        """Return the product of the transpose with an image, (N, C)."""
        return torch.autograd.grad(self.rendered, self._leaf, image, retain_graph=True)[0]


def is_better(rendered: Tensor, before: Tensor, image: Tensor) -> bool:
    """Say whether the squared error fell, and PSNR, which is taken on clipped images, did not."""
    clipped = [t.clamp(0.0, 1.0) for t in (rendered, before, image)]
    (new, old), (new_seen, old_seen) = (
        [(t - target).double().square().sum() for t in both] for *both, target in ((rendered, before, image), clipped)
    )
    return bool((new < old) & (new_seen <= old_seen))
