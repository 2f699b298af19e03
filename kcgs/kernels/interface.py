"""Inputs and functions of a kernel. Every kernel's module has `kernel_for(inputs)`, which the registry calls."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from torch import Tensor

from kcgs.maps import MapTable

Gradients = tuple[Tensor | None, Tensor | None, Tensor]


class SplatInputs(NamedTuple):
    """Arguments of one splat, checked and batched unless the kernel does so itself (see `Kernel`).

    Floating tensors share one dtype (float32 or float64) and one device.
    """

    means: Tensor  # [B, N, 2] pixels
    cholesky: Tensor  # [B, N, 3] pixels
    colors: Tensor  # [B, N, C]
    region_positions: Tensor | None  # [B, N] int64, among the ids of the table; -1: not in the map
    table: MapTable | None  # of the map at its own size, with ids; None: one region covers everything
    size: tuple[int, int]  # (height, width)
    cutoff: float
    region_ids: Tensor | None = None  # [B, N] int64, in place of positions for a kernel that looks them up

    @property
    def gaussians(self) -> tuple[Tensor, Tensor, Tensor]:
        """Means, Cholesky factors and colours."""
        return self[:3]

    @property
    def num_images(self) -> int:
        """B, 1 where it is left out."""
        return self.means.shape[0] if self.means.ndim == 3 else 1

    def with_batch(self) -> SplatInputs:
        """Return these inputs with the dimension B, which Gaussians of one image may lack."""
        if self.means.ndim == 3:
            return self
        return SplatInputs(self.means[None], self.cholesky[None], self.colors[None], *self[3:])


class Kernel(NamedTuple):
    """A kernel: three functions that record no graph, and abilities that only some kernels have."""

    plan: Callable[[SplatInputs], Any]
    """Takes the inputs; returns which Gaussians touch which pixels, in the kernel's own format."""
    render: Callable[[Any, SplatInputs], Tensor]
    """Takes (plan, inputs); returns the image, (B, C, H, W)."""
    differentiate: Callable[[Any, SplatInputs, Tensor, bool], Gradients]
    """Takes (plan, inputs, gradient of the image, geometry); returns the gradients of means, cholesky and colors. The
    first two are None unless `geometry`."""
    image: Callable[[SplatInputs], Tensor] | None = None
    """Takes the inputs; returns the image with a graph of all orders. None: the kernel is differentiable once."""
    error_gradients: Callable[[Any, SplatInputs, Tensor], Gradients] | None = None
    """Takes (plan, inputs, target); returns the gradients of half the squared error against the target, (B, C, H, W),
    in one pass. None: the kernel has no such pass."""
    checks_values: bool = False
    """`plan` returns None if, and only if, a value is not finite or beyond the limits in whitened.py. False: the caller
    has checked the values."""
    takes_one_image: bool = False
    """Gaussians of one image may come without B; the results then have no B either. False: B is there."""
    looks_up_regions: bool = False
    """The kernel takes `region_ids`, and looks up their positions. `plan` returns None for negative ids, too; its
    `num_unknown_ids` is the number of Gaussians whose id the map does not hold."""
