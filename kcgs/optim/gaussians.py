"""Gaussians as plain tensors, and their renderer."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from kcgs.functional import region_splat, squared_error_gradients
from kcgs.maps import RegionMap
from kcgs.nn import GaussianField

# cutoff of descents whose result is rendered with a smaller cutoff; it saves a third of the weights of 1e-4
_DRAFT_CUTOFF = 1e-3


def draft_cutoff(cutoff: float) -> float:
    """Return the cutoff of a descent whose result is rendered with `cutoff`."""
    return max(cutoff, _DRAFT_CUTOFF)


class Gaussians(NamedTuple):
    """The numbers of the Gaussians of an image or a batch, or a gradient by each of them."""

    means: Tensor  # [..., N, 2]
    cholesky: Tensor  # [..., N, 3]
    colors: Tensor  # [..., N, C]
    region_ids: Tensor | None = None  # [..., N]

    @classmethod
    def of(cls, field: GaussianField) -> Gaussians:
        """Take the Gaussians of a field, without the graph; opacities are merged into the colours."""
        return cls(field.means.detach(), field.cholesky.detach(), field.merged_colors().detach(), field.region_ids)

    def of_image(self, index: int) -> Gaussians:
        """Return the Gaussians of one image of a batch."""
        return Gaussians(*(table if table is None else table[index] for table in self))  # type: ignore[arg-type]

    def field(self, size: tuple[int, int]) -> GaussianField:
        """Copy the Gaussians into a field."""
        return GaussianField(*self, size=size)

    def map(self, function: Callable[..., Tensor], *others: Gaussians) -> Gaussians:
        """Apply a function to means, factors and colours, each with the same tables of `others`; the ids stay."""
        tables = zip(self[:3], *(other[:3] for other in others), strict=True)
        means, cholesky, colors = (function(*numbers) for numbers in tables)
        return Gaussians(means, cholesky, colors, self.region_ids)


class Renderer(NamedTuple):
    """Renders Gaussians of an image or a batch, with one map or one for each, a cutoff and a backend."""

    size: tuple[int, int]
    regions: RegionMap | None = None
    cutoff: float = _DRAFT_CUTOFF
    backend: str = "auto"
    bounds: tuple[Tensor, Tensor] | None = None
    """Values to which the render is clipped, (..., C, H, W) or scalars; a clipped value has no gradient."""

    def of_image(self, index: int, regions: RegionMap | None) -> Renderer:
        """Return the renderer of one image of a batch, with its map."""
        bounds = self.bounds
        if bounds is not None and bounds[0].ndim:
            bounds = bounds[0][index], bounds[1][index]
        return self._replace(regions=regions, bounds=bounds)

    def render(self, gaussians: Gaussians) -> Tensor:
        """Render (..., C, H, W)."""
        render = region_splat(*gaussians, self.regions, size=self.size, cutoff=self.cutoff, backend=self.backend)
        return render if self.bounds is None else render.clamp(*self.bounds)

    def squared_error(self, gaussians: Gaussians, image: Tensor) -> Tensor:
        """Return the squared error of each pixel, (..., H, W), channels averaged."""
        return (self.render(gaussians).detach() - image).square().mean(-3)

    def squared_error_gradients(self, gaussians: Gaussians, image: Tensor) -> Gaussians:
        """Return half the gradients of the squared error of the unclipped render, summed over pixels, in one pass."""
        return Gaussians(
            *squared_error_gradients(image, *gaussians, self.regions, cutoff=self.cutoff, backend=self.backend)
        )

    def inner_products(self, gaussians: Gaussians) -> Tensor:
        """Return the inner product of the render and each Gaussian's weights, (N, C), if possible in one pass."""
        # against a black image, half the gradient by a colour is the inner product
        *batch, _, channels = gaussians.colors.shape
        black = gaussians.colors.new_zeros(*batch, channels, *self.size)
        return self.squared_error_gradients(gaussians, black).colors

    @torch.enable_grad()
    def weight_sums(self, gaussians: Gaussians) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        """Return the sum of weights per pixel, (..., 1, H, W), and a function from such a map to sums per Gaussian."""
        ones = torch.ones_like(gaussians.colors[..., :1]).requires_grad_()
        total = self.render(gaussians._replace(colors=ones))
        # the render is linear in the colours, so its gradient by them has the sums
        return total.detach(), lambda values: torch.autograd.grad(total, ones, values, retain_graph=True)[0][..., 0]
