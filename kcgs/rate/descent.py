"""Rate-distortion descent: Gaussians lower their error and, at a price, their bits."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcgs.codec.exact import Integers
from kcgs.codec.gaussians.quantize import Parameters, Quantizer
from kcgs.fitting.descent import DRAFT_CUTOFF
from kcgs.fitting.objective import MsSsimObjective
from kcgs.functional import RegionMap, region_splat
from kcgs.functional.splat import squared_error_gradients
from kcgs.optim.newton import Gaussians, NewtonDescent, area, error_weights, half_gradients

from .bits import soft_bits

# Prices are in units of D, the distortion that one rounded number adds. In theory a bit saves 2 ln 2 D = 1.4 D. Here
# neighbours correct rounding errors, so both numbers are tuned: vary one and compare `python -m benchmarks rate`.

# error that a bit must save: a higher price makes Gaussians cheaper, and the image worse before they are rounded
_BIT_PRICE = 0.9
# energy of a Gaussian that pays for its bits, about 30: a higher one leaves fewer Gaussians, each rounded less
_GAUSSIAN_PRICE = 20.0
# share of a Newton step in a step: larger ones oscillate, smaller ones take more iterations
_RATE = 0.09
# steps for which the gradient of the bits, and what errors weigh, are reused, which change slowly
_REUSE_STEPS = 4


class RateDistortionDescent:
    """Gaussians on their way to less error and fewer bits.

    The Newton steps are those of :class:`kcgs.optim.newton.NewtonDescent`, which the frames of a video take, too. This
    descent adds the price of bits and moves contours never; when Gaussians are pruned or rounded, its callers say.

    Args:
        gaussians: the start.
        ids: region of each Gaussian, (N,), as a position in the map's ids.
        image: (C, h, w), on the CPU: the photo, or without a map a reduced one.
        regions: the map, which stays.
        objective: the error; None: the squared error.
        size: (H, W) of the photo.
        min_sigma: least standard deviation of a Gaussian, in pixels of the photo.
    """

    def __init__(
        self,
        gaussians: Parameters,
        ids: Integers,
        image: Tensor,
        regions: RegionMap | None,
        objective: MsSsimObjective | None,
        size: tuple[int, int],
        min_sigma: float = 0.0,
    ) -> None:
        self.ids, self.image, self.regions, self.objective = ids, image, regions, objective
        scale = image.new_tensor([image.shape[2] / size[1], image.shape[1] / size[0]])
        self._scale = Gaussians(scale, scale[[0, 1, 1]], torch.ones_like(scale[:1]))
        self._num_pixels = size[0] * size[1]
        self.gaussians = self._as_tensors(gaussians)
        # steps are so short that the first order of the shear is enough
        self.newton = NewtonDescent(self.gaussians, exact=False, min_sigma=min_sigma)
        self._error_weights = error_weights(self._scaled(self.gaussians), objective)
        self._error_scale = float(self._error_weights.mean())
        self._bit_gradient: Gaussians | None = None
        self._num_steps = 0

    def parameters(self) -> Parameters:
        """Return the Gaussians in float64."""
        return Parameters(*(numbers.double().numpy() for numbers in self.gaussians))

    def step(self, quantizer: Quantizer) -> None:
        """Move all Gaussians once."""
        self.gaussians = self._step_from(self.gaussians, quantizer)

    def step_around(
        self, rounded_values: Parameters, shape_mask: Tensor, color_mask: Tensor, quantizer: Quantizer
    ) -> None:
        """Move all numbers once but those of a mask, which have their rounded values in this step.

        Args:
            rounded_values: of all Gaussians.
            shape_mask: Gaussians whose place and shape are rounded, bool (N,).
            color_mask: Gaussians whose colour is rounded, bool (N,).
            quantizer: of the file.
        """
        masks = Gaussians(shape_mask[:, None], shape_mask[:, None], color_mask[:, None])
        current = _where(masks, self._as_tensors(rounded_values), self.gaussians)
        frozen = torch.cat([masks.cholesky.expand(-1, 5), masks.colors.expand(-1, self.image.shape[0])], -1)
        # numbers of the mask keep their values before rounding: later they may be rounded to others
        self.gaussians = _where(masks, self.gaussians, self._step_from(current, quantizer, frozen))

    def prune(self, quantizer: Quantizer) -> None:
        """Remove the Gaussians that do not pay for their bits; one stays at least."""
        energy = self._energy()
        rows = energy >= _GAUSSIAN_PRICE * self._error_scale * quantizer.distortion
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
        self.ids, self.newton.velocity = self.ids[rows], self.newton.velocity[index]
        self.gaussians = Gaussians(*(numbers[index] for numbers in self.gaussians))
        self._bit_gradient = None

    def _step_from(self, gaussians: Gaussians, quantizer: Quantizer, frozen: Tensor | None = None) -> Gaussians:
        height, width = quantizer.size
        if self._bit_gradient is None or self._num_steps % _REUSE_STEPS == 0:
            self._bit_gradient = self._half_bit_gradient(gaussians, quantizer)
            self._error_weights = error_weights(self._scaled(gaussians), self.objective)
        self._num_steps += 1
        gradients = self._half_error_gradient(gaussians)
        gradients = Gaussians(*(error + bits for error, bits in zip(gradients, self._bit_gradient, strict=True)))
        color_curvature = area(gaussians.cholesky).clamp_max(height * width) * self._error_weights
        return self.newton.step(gaussians, gradients, color_curvature, _RATE, frozen)

    def _half_bit_gradient(self, gaussians: Gaussians, quantizer: Quantizer) -> Gaussians:
        """Return half the gradient of the price of the bits, which is 0 by means."""
        cholesky, colors = (t.detach().requires_grad_() for t in gaussians[1:])
        price = 0.5 * _BIT_PRICE * self._error_scale * quantizer.distortion
        bits = price * soft_bits(cholesky, colors, quantizer).sum()
        return Gaussians(torch.zeros_like(gaussians.means), *torch.autograd.grad(bits, (cholesky, colors)))

    def _half_error_gradient(self, gaussians: Gaussians) -> Gaussians:
        """Return half the gradient of the error, summed over the pixels of the photo."""
        scaled = self._scaled(gaussians)
        if self.objective is not None:
            gradients = half_gradients(self._render, scaled, self.image, self.objective)
        else:
            ids = self._region_ids()
            gradients = Gaussians(
                *squared_error_gradients(self.image, *scaled, ids, self.regions, cutoff=DRAFT_CUTOFF, backend="auto")
            )
        # a pixel of the image stands for so many of the photo
        pixels = self._num_pixels / self.image[0].numel()
        return self._scaled(Gaussians(*(pixels * gradient for gradient in gradients)))

    def _scaled(self, gaussians: Gaussians) -> Gaussians:
        """Return Gaussians, or gradients by those, as they are on the image."""
        return Gaussians(*(numbers * scale for numbers, scale in zip(gaussians, self._scale, strict=True)))

    def _render(self, means: Tensor, cholesky: Tensor, colors: Tensor) -> Tensor:
        size = self.image.shape[1], self.image.shape[2]
        return region_splat(means, cholesky, colors, self._region_ids(), self.regions, size=size, cutoff=DRAFT_CUTOFF)

    def _region_ids(self) -> Tensor | None:
        return None if self.regions is None else self.regions.ids[torch.from_numpy(self.ids)]

    def _energy(self) -> Tensor:
        """Return the error that each Gaussian saves, (N,), if no other overlaps it."""
        gaussians = Gaussians(*(numbers.double() for numbers in self.gaussians))
        l11, _, l22 = gaussians.cholesky.unbind(-1)
        areas = (math.pi * l11 * l22).clamp_max(self._num_pixels)
        return error_weights(self._scaled(gaussians), self.objective) * (gaussians.colors.square().sum(-1) * areas)

    def _as_tensors(self, gaussians: Parameters) -> Gaussians:
        return Gaussians(*(torch.from_numpy(numbers).to(self.image) for numbers in gaussians))


def _where(masks: Gaussians, values: Gaussians, others: Gaussians) -> Gaussians:
    return Gaussians(*(torch.where(*numbers) for numbers in zip(masks, values, others, strict=True)))
