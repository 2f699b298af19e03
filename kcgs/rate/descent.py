"""Rate-distortion descent: Gaussians lower their error and, at a price, their bits."""

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
# neighbours correct rounding errors, so both numbers are tuned: vary one and compare `python -m benchmarks rate`.

# error that a bit must save: a higher price makes Gaussians cheaper, and the image worse before they are rounded
_BIT_PRICE = 0.9
# energy of a Gaussian that pays for its bits, about 30: a higher one leaves fewer Gaussians, each rounded less
_GAUSSIAN_PRICE = 20.0
# share of a Newton step in a step: larger ones oscillate, smaller ones take more iterations
RATE = 0.09
# steps for which the gradient of the bits, and what errors weigh, are reused, which change slowly
_REUSE_STEPS = 4


class RateDistortionDescent(NewtonDescent):
    """Gaussians on their way to less error and fewer bits.

    To the Newton steps of the error this adds the price of bits, at `quantizer`, and numbers that are rounded.

    Args:
        writer: of the start, with its map, which stays.
        objective: of the photo, on the CPU, or without a map of a reduced one.
        min_sigma: least standard deviation of a Gaussian, in pixels of the photo.
    """

    quantizer: Quantizer
    """Of the file, at the moment."""

    def __init__(self, writer: SceneWriter, objective: ImageObjective, min_sigma: float = 0.0) -> None:
        image, (height, width) = objective.image, writer.size
        size = image.shape[1], image.shape[2]
        scale = image.new_tensor([size[1] / width, size[0] / height])
        self._scale = Gaussians(scale, scale[[0, 1, 1]], torch.ones_like(scale[:1]))
        self._num_pixels, self.ids = height * width, writer.ids
        gaussians = self._as_tensors(writer.gaussians, image)
        renderer = Renderer(size, writer.regions)
        # steps are so short that the first order of the shear is enough
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
        """Give the numbers of a mask their rounded values in the steps from here on, in which they do not move.

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
        """Move all numbers but those that are rounded."""
        free = self.gaussians
        if self._rounded is None:
            super().step(rate)
            return
        masks, values = self._rounded
        self.gaussians = masks.map(torch.where, values, free)
        super().step(rate)
        # the others keep their values before rounding: later they may be rounded to others
        self.gaussians = masks.map(torch.where, free, self.gaussians)

    def prune(self) -> None:
        """Remove the Gaussians that do not pay for their bits; one stays at least."""
        energy = self._energy()
        rows = energy >= _GAUSSIAN_PRICE * self._error_scale * self.quantizer.distortion
        rows[energy.argmax()] = True
        self._select(rows.numpy())

    def remove_weakest(self, count: int) -> NDArray[np.bool_]:
        """Remove so many of the weakest Gaussians, but one stays at least; return the mask of those that stay."""
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
        """Return half the gradients of the error, summed over the pixels of the photo, and of the price of the bits."""
        if self._bit_gradient is None or self.iteration % _REUSE_STEPS == 0:
            self._bit_gradient = self._half_bit_gradient()
            self._error_weights = self._weigh(self.gaussians)
        ids = None if self.renderer.regions is None else self.renderer.regions.ids[torch.from_numpy(self.ids)]
        gradients = self.objective.gradients(self.renderer, self._scaled(self.gaussians)._replace(region_ids=ids))
        # a pixel of the image stands for so many of the photo
        pixels = self._num_pixels / (self.renderer.size[0] * self.renderer.size[1])
        scaled = self._scaled(gradients.map(lambda gradient: pixels * gradient))
        return scaled.map(torch.add, self._bit_gradient)

    def color_curvature(self) -> Tensor:
        """Return half the second derivative of the error by a colour, (N,)."""
        return self_product(self.gaussians.cholesky).clamp_max(self._num_pixels) * self._error_weights

    def _half_bit_gradient(self) -> Gaussians:
        """Return half the gradient of the price of the bits, which is 0 by means."""
        cholesky, colors = (t.detach().requires_grad_() for t in self.gaussians[1:3])
        price = 0.5 * _BIT_PRICE * self._error_scale * self.quantizer.distortion
        bits = price * soft_bits(cholesky, colors, self.quantizer).sum()
        return Gaussians(torch.zeros_like(self.gaussians.means), *torch.autograd.grad(bits, (cholesky, colors)))

    def _scaled(self, gaussians: Gaussians) -> Gaussians:
        """Return Gaussians, or gradients by those, as they are on the image."""
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
