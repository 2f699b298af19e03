"""What a descent lowers, as a function of the render."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from kcgs._torch_internals import differentiate
from kcgs.errors import InvalidArgument

from .gaussians import Gaussians, Renderer

Loss = Callable[[Tensor], Tensor]

# number of steps along the slope of a loss that are tried, each half as long as the one before
_NUM_STEPS = 10


class Residual(NamedTuple):
    """What a render lacks, as a weighted error; colours of Gaussians proposed for it are divided by `root`."""

    error: Tensor  # [..., C, H, W], its square is what a Gaussian may gain
    root: Tensor | float = 1.0  # [..., H, W], root of each pixel's weight, by which colours are divided


class Objective(ABC):
    """What a descent lowers: a function of the render, (..., C, H, W), with its slope; one value per image."""

    is_ranked_by_psnr = True
    """The best state of a descent has the highest PSNR; False: the lowest value."""
    power: int | None = None
    """The value is the mean of this power of the absolute difference from the image; None: it is not such a mean."""

    @abstractmethod
    def slope(self, render: Tensor) -> Tensor:
        """Return the gradient at a render, whose memory this method may overwrite, times a positive factor.

        The gradient is taken of the value times the number of values, so of a sum where the value is a mean. The factor
        is one half for the objectives of Newton's method, the squared error and MS-SSIM; Adam ignores it.
        """

    @abstractmethod
    def value(self, render: Tensor) -> Tensor:
        """Return the mean error of a render as a scalar on its device, or (B,)."""

    @abstractmethod
    def residual(self, render: Tensor) -> Residual:
        """Return what a render lacks."""

    def weigh(self, gaussians: Gaussians) -> Tensor:
        """Return about the weight of each Gaussian's squared error, (..., N)."""
        return torch.ones_like(gaussians.means[..., 0])

    def has_fused_gradients(self, renderer: Renderer) -> bool:
        """Return whether gradients need no render of their own."""
        return False

    def gradients(self, renderer: Renderer, gaussians: Gaussians, render: Tensor | None = None) -> Gaussians:
        """Return the gradients by Gaussians, times the factor of `slope`.

        A `render` that is given has a graph to the Gaussians.
        """
        leaves = gaussians
        if render is None:
            leaves = gaussians.map(lambda table: table.detach().requires_grad_())
            with torch.enable_grad():
                render = renderer.render(leaves)
        # `data`, since the slope may overwrite it, which the graph does not notice
        return Gaussians(*differentiate(render, leaves[:3], self.slope(render.data)))


class ImageObjective(Objective):
    """An error of a render against an image, (..., C, H, W); subclasses say of which kind.

    `reduction` is the factor by which the sides of a photo were reduced to those of the image; few errors depend on it.
    """

    def __init__(self, image: Tensor, reduction: int = 1) -> None:
        self.image = image

    def residual(self, render: Tensor) -> Residual:
        """Return the difference of the image from a render."""
        return Residual(self.image - render)


class SquaredError(ImageObjective):
    """The squared error, with an optional weight of each pixel, (H, W)."""

    def __init__(self, image: Tensor, reduction: int = 1, *, weight: Tensor | None = None) -> None:
        super().__init__(image)
        self.weight = weight
        self.power = 2 if weight is None else None

    def slope(self, render: Tensor) -> Tensor:
        """Return the difference, in the memory of the render: new memory would take as long as the sum."""
        difference = render.sub_(self.image)
        return difference if self.weight is None else difference.mul_(self.weight)

    def value(self, render: Tensor) -> Tensor:
        """Return the mean squared error."""
        square = (render - self.image).square()
        return (square if self.weight is None else self.weight * square).mean((-3, -2, -1))

    def has_fused_gradients(self, renderer: Renderer) -> bool:
        """Return whether the error is unweighted and the render unclipped."""
        return self.weight is None and renderer.bounds is None

    def gradients(self, renderer: Renderer, gaussians: Gaussians, render: Tensor | None = None) -> Gaussians:
        """Render and differentiate at once, where that is possible."""
        if render is None and self.has_fused_gradients(renderer):
            return renderer.squared_error_gradients(gaussians, self.image)
        return super().gradients(renderer, gaussians, render)


class AbsoluteError(ImageObjective):
    """The mean absolute error."""

    power = 1

    def slope(self, render: Tensor) -> Tensor:
        """Return the sign of the difference."""
        return render.sub_(self.image).sign_()

    def value(self, render: Tensor) -> Tensor:
        """Return the mean absolute error."""
        return (render - self.image).abs().mean((-3, -2, -1))


class LossObjective(Objective):
    """A loss of the user.

    Args:
        loss: takes a render, (1, C, H, W), and returns a scalar.
        image: (1, C, H, W). Gaussians are added where the render differs from it; None: along the slope of the loss.
    """

    is_ranked_by_psnr = False

    def __init__(self, loss: Loss, image: Tensor | None = None) -> None:
        self.loss, self.image = loss, image

    def slope(self, render: Tensor) -> Tensor:
        """Return the gradient, times the number of values, as if the loss were their mean."""
        leaf = render.detach().requires_grad_()
        with torch.enable_grad():
            loss = self._check(self.loss(leaf))
        if not loss.requires_grad:
            raise InvalidArgument("objective", "a loss that depends on the render", "one without a graph")
        return torch.autograd.grad(loss, leaf)[0] * leaf.numel()

    @torch.no_grad()
    def value(self, render: Tensor) -> Tensor:
        """Return the loss, (1,)."""
        return self._check(self.loss(render.detach())).reshape(1)

    def residual(self, render: Tensor) -> Residual:
        """Return the image minus the render; without an image, the step along the slope that lowers the loss most.

        The longest step that is tried changes the value with the largest slope by 1.
        """
        if self.image is not None:
            return Residual(self.image - render)
        slope = self.slope(render)
        largest = slope.abs().max().clamp_min(torch.finfo(slope.dtype).tiny)  # a slope of 0 gives steps of 0
        steps = [slope * (-(0.5**k) / largest) for k in range(_NUM_STEPS)]
        return Residual(min(steps, key=lambda step: float(self.value(render + step))))

    @staticmethod
    def _check(loss: object) -> Tensor:
        if not isinstance(loss, Tensor) or loss.numel() != 1:
            received = f"shape {tuple(loss.shape)}" if isinstance(loss, Tensor) else type(loss).__name__
            raise InvalidArgument("objective", "a function that returns a scalar tensor", received)
        return loss.reshape(())
