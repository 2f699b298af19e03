"""Rate-distortion descent: Gaussians lower their error plus the price of their bits."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcgs.codec import Parameters, Quantizer, SceneWriter
from kcgs.optim import Gaussians, ImageObjective, NewtonDescent, Renderer, self_product

from .bits import soft_bits

# Prices are in units of D, the distortion that one rounded number adds. In theory a bit saves 2 ln 2 D = 1.4 D. Here
# neighbours correct rounding errors, so both prices are tuned: change one and compare `python -m benchmarks rate`.

# error that a bit must save; higher: Gaussians take fewer bits, and the image is worse before rounding
_BIT_PRICE = 0.9
# energy that a Gaussian of about 30 bits must have; higher: fewer Gaussians, each rounded less
_GAUSSIAN_PRICE = 20.0
# step size, as a share of the Newton step; larger steps oscillate, smaller steps take more iterations
RATE = 0.09
# steps that reuse the gradient of the bits and the weights of errors: both change slowly
_REUSE_STEPS = 4


class RateDistortionDescent(NewtonDescent):
    """A descent of Gaussians to less error and fewer bits.

    It extends the Newton steps of the error by the price of bits at `quantizer`, and by rounded numbers.

    Args:
        writer: has the first Gaussians and the map, which does not change.
        objective: of the photo, on the CPU; without a map also of a reduced photo.
        min_sigma: least standard deviation of a Gaussian, in pixels of the photo.
    """

    quantizer: Quantizer
    """The current quantizer of the file."""

    def __init__(self, writer: SceneWriter, objective: ImageObjective, min_sigma: float = 0.0) -> None:
        image, (height, width) = objective.image, writer.size
        size = image.shape[1], image.shape[2]
        scale = image.new_tensor([size[1] / width, size[0] / height])
        self._scale = Gaussians(scale, scale[[0, 1, 1]], torch.ones_like(scale[:1]))
        self._num_pixels, self.ids = height * width, writer.ids
        gaussians = self._as_tensors(writer.gaussians, image)
        renderer = Renderer(size, writer.regions)
        # steps are short: the first order of the shear is enough
        super().__init__(gaussians, objective, renderer, exact=False, min_sigma=min_sigma)
        self._image = image
        self._error_weights = self._weigh(self.gaussians)
        self._error_scale = float(self._error_weights.mean())
        self._bit_gradient: Gaussians | None = None
        self._rounded: tuple[Gaussians, Gaussians] | None = None

    def parameters(self) -> Parameters:
        """Return the Gaussians in float64."""
        return Parameters(*(numbers.double().numpy() for numbers in self.gaussians[:3]))

    def round(self, values: Parameters, shape_mask: Tensor, color_mask: Tensor) -> None:
        """Fix the numbers of a mask at their rounded values in all further steps.

        Args:
            values: of all Gaussians.
            shape_mask: Gaussians whose place and shape are rounded, bool (N,).
            color_mask: Gaussians whose colour is rounded, bool (N,).
        """
        masks = Gaussians(shape_mask[:, None], shape_mask[:, None], color_mask[:, None])
        self._rounded = masks, self._as_tensors(values, self._image)
        frozen = masks.cholesky.expand(-1, 5), masks.colors.expand(-1, self.gaussians.colors.shape[1])
        self.frozen = torch.cat(frozen, -1)

    def step(self, rate: float) -> None:
        """Move all numbers that are not rounded."""
        free = self.gaussians
        if self._rounded is None:
            super().step(rate)
            return
        masks, values = self._rounded
        self.gaussians = masks.map(torch.where, values, free)
        super().step(rate)
        # rounded numbers keep their values from before rounding: later they may be rounded to other values
        self.gaussians = masks.map(torch.where, free, self.gaussians)

    def prune(self) -> None:
        """Remove the Gaussians that save less error than their bits cost; at least one stays."""
        energy = self._energy()
        rows = energy >= _GAUSSIAN_PRICE * self._error_scale * self.quantizer.distortion
        rows[energy.argmax()] = True
        self._select(rows.numpy())

    def remove_weakest(self, count: int) -> NDArray[np.bool_]:
        """Remove the `count` weakest Gaussians, but at least one stays; return a mask of the remaining ones."""
        rank = self._energy().argsort(stable=True).argsort().numpy()
        rows = rank >= min(count, len(rank) - 1)
        self._select(rows)
        return rows

    def _select(self, rows: NDArray[np.bool_]) -> None:
        index = torch.from_numpy(rows)
        self.ids, self.velocity = self.ids[rows], self.velocity[index]
        self.gaussians = self.gaussians.map(lambda numbers: numbers[index])
        self._bit_gradient = None

    def half_gradients(self) -> Gaussians:
        """Return half the gradients of error plus price of bits; the error is a sum over the pixels of the photo."""
        if self._bit_gradient is None or self.iteration % _REUSE_STEPS == 0:
            self._bit_gradient = self._half_bit_gradient()
            self._error_weights = self._weigh(self.gaussians)
        ids = None if self.renderer.regions is None else self.renderer.regions.ids[torch.from_numpy(self.ids)]
        gradients = self.objective.gradients(self.renderer, self._scaled(self.gaussians)._replace(region_ids=ids))
        # pixels of the photo per pixel of the reduced image
        pixels = self._num_pixels / (self.renderer.size[0] * self.renderer.size[1])
        scaled = self._scaled(gradients.map(lambda gradient: pixels * gradient))
        return scaled.map(torch.add, self._bit_gradient)

    def color_curvature(self) -> Tensor:
        """Return half the second derivative of the error with respect to a colour, (N,)."""
        return self_product(self.gaussians.cholesky).clamp_max(self._num_pixels) * self._error_weights

    def _half_bit_gradient(self) -> Gaussians:
        """Return half the gradient of the price of the bits; it is 0 for means."""
        cholesky, colors = (t.detach().requires_grad_() for t in self.gaussians[1:3])
        price = 0.5 * _BIT_PRICE * self._error_scale * self.quantizer.distortion
        bits = price * soft_bits(cholesky, colors, self.quantizer).sum()
        return Gaussians(torch.zeros_like(self.gaussians.means), *torch.autograd.grad(bits, (cholesky, colors)))

    def _scaled(self, gaussians: Gaussians) -> Gaussians:
        """Scale Gaussians to the image's size, or gradients on the image to those of the Gaussians."""
        return gaussians.map(torch.mul, self._scale)

    def _weigh(self, gaussians: Gaussians) -> Tensor:
        return self.objective.weigh(self._scaled(gaussians))

    def _energy(self) -> Tensor:
        """Return the error that each Gaussian saves, (N,), if no other overlaps it."""
        gaussians = self.gaussians.map(Tensor.double)
        l11, _, l22 = gaussians.cholesky.unbind(-1)
        areas = (math.pi * l11 * l22).clamp_max(self._num_pixels)
        return self._weigh(gaussians) * (gaussians.colors.square().sum(-1) * areas)

    @staticmethod
    def _as_tensors(gaussians: Parameters, image: Tensor) -> Gaussians:
        return Gaussians(*(torch.from_numpy(numbers).to(image) for numbers in gaussians))
