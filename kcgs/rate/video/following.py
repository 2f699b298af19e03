"""Gaussians of a frame that descend on its error and on the bits of what changes, and are rounded a few at a time."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from kcgs.codec.clips.carried import LEAST_FACTOR, MOST_FACTOR, are_sound
from kcgs.codec.clips.differences import CURVATURE, Differences
from kcgs.codec.exact import Integers
from kcgs.codec.gaussians.quantize import OPPONENT, Parameters
from kcgs.fitting.frame import local_gradient, move
from kcgs.fitting.objective import VisualObjective
from kcgs.functional import RegionMap, region_splat

# of a descent's step: share of Newton's, what is kept of the step before; bounds in the Gaussian's frame
_STEP, _MOMENTUM, _LARGEST, _NEWTON = 0.09, 0.9, 0.2, 0.3
# pixels; energies below it have next to no curvature
_NARROW, _FAINT = 0.56, 1e-2
_DRAFT_CUTOFF = 1e-3
# bits of a number that is u steps from none: this times log2(1 + u^2 / this)
_BITS, _SOFT = 2.0, 0.05
# bits of a number that is not 0, more for each doubling of it; bits of a Gaussian that changes
_SOME, _DOUBLING, _CHANGED = 2.2, 2.0, 2.5
# share of the rounding in which shapes are rounded, and iterations between two times
_SHAPES, _GROUP = 0.65, 3


class Following:
    """Gaussians (float32 tensors) on the way to a frame (C, H, W).

    Args:
        image: the frame.
        regions: its map, or None.
        region_ids: of the Gaussians, (N,), or None.
        differences: from the moved Gaussians of the frame before; those of `born` begin where they are.
        born: how many of the last Gaussians are new: their bits are paid, and rounding leaves them as they are.
        price: squared error that a bit must save.
        objective: what the error is measured by; None: squared error.
    """

    def __init__(
        self,
        image: Tensor,
        regions: RegionMap | None,
        region_ids: Tensor | None,
        differences: Differences,
        born: int,
        price: float,
        objective: VisualObjective | None = None,
    ) -> None:
        self.image, self.regions, self.region_ids, self.objective = image, regions, region_ids, objective
        self.born, self.price, self.differences = born, price, differences
        self._base = [torch.from_numpy(numbers).to(image) for numbers in differences.base]
        self._steps = torch.from_numpy(differences.steps).to(image)
        channels = self._base[2].shape[1]
        self._opponent = (torch.tensor(OPPONENT) if channels == 3 else torch.eye(channels)).to(image)
        self._curvature = torch.tensor(CURVATURE).to(image)
        self.gaussians = list(self._base)
        self.speed = torch.zeros_like(self._steps)

    def take(self, gaussians: list[Tensor], speed: Tensor) -> None:
        """Go on from these."""
        self.gaussians, self.speed = gaussians, speed

    def render(self) -> Tensor:
        """Render what is free, (C, H, W)."""
        size = (self.image.shape[1], self.image.shape[2])
        with torch.no_grad():
            means, cholesky, colors = self.gaussians
            return region_splat(means, cholesky, colors, self.region_ids, self.regions, size=size, cutoff=_DRAFT_CUTOFF)

    def descend(self, iterations: int) -> None:
        """Move all downhill."""
        for _ in range(iterations):
            self.speed = _MOMENTUM * self.speed + self._downhill(self.gaussians)
            self.gaussians = self._moved(self.gaussians, self.speed)

    def round(self, iterations: int, seed: int) -> Integers:
        """Round everything in so many iterations, in an order of the seed; return the whole numbers [N, 5 + C]."""
        generator = torch.Generator().manual_seed(seed)
        turn = torch.rand(2, len(self._steps), generator=generator).to(self.image)
        kept = len(self._steps) - self.born
        turn[:, kept:] = -math.inf  # fixed from the start
        new = [t[kept:] for t in self.gaussians]
        for iteration in range(iterations):
            share = iteration / iterations
            if iteration % _GROUP == 0:
                rounded = self._restore(self._quantize())
                rounded = [torch.cat([t[:kept], n]) for t, n in zip(rounded, new, strict=True)]
                shaped, colored = turn[0] < share / _SHAPES, turn[1] < (share - _SHAPES) / (1 - _SHAPES)
                shaped, colored = shaped[:, None], colored[:, None]
            fixed = shaped, shaped, colored
            current = [torch.where(f, r, g) for f, r, g in zip(fixed, rounded, self.gaussians, strict=True)]
            speed = _MOMENTUM * self.speed + self._downhill(current)
            stopped = torch.cat([shaped.expand(-1, 5), colored.expand(-1, speed.shape[1] - 5)], -1)
            self.speed = torch.where(stopped, 0.0, speed)
            moved = self._moved(current, self.speed)
            self.gaussians = [torch.where(f, g, m) for f, g, m in zip(fixed, self.gaussians, moved, strict=True)]
        codes: Integers = self._quantize().double().numpy().astype(np.int64)
        codes *= self.differences.can_be(codes)[:, None]
        return codes * are_sound(self.differences.restore(codes))[:, None]

    def parameters(self) -> Parameters:
        """Return the Gaussians in float64."""
        return Parameters(*(numbers.double().numpy() for numbers in self.gaussians))

    def weights(self) -> Tensor:
        """Return what the squared error of Gaussians counts in the objective, (N,)."""
        means, cholesky, _ = self.gaussians
        return torch.ones_like(means[:, 0]) if self.objective is None else self.objective.weigh(means, cholesky)

    def _quantize(self) -> Tensor:
        """Return whole numbers: those of a Gaussian are 0 where they do not pay for their bits."""
        steps = self._measure(self.gaussians) / self._steps
        codes = steps.sign() * (steps.abs() + 0.5).floor()
        size = codes.abs()
        # a step adds twelve times the distortion, which the steps are made of
        gain = 12 * self.differences.distortion * (steps.square() - (steps - codes).square()).sum(-1)
        bits = ((_SOME + _DOUBLING * size.clamp_min(1).log2()) * (size > 0)).sum(-1) + _CHANGED
        codes = codes * (gain > self.price * bits)[:, None]
        return codes

    def _measure(self, gaussians: list[Tensor]) -> Tensor:
        means, cholesky, colors = self._base
        l11, l21, l22 = cholesky.unbind(-1)
        n11, n21, n22 = gaussians[1].unbind(-1)
        dx, dy = (gaussians[0] - means).unbind(-1)
        d1 = dx / l11
        shape = d1, (dy - l21 * d1) / l22, (n11 / l11).log(), (n21 - l21 * (n11 / l11)) / l22, (n22 / l22).log()
        return torch.cat([torch.stack(shape, -1), (gaussians[2] - colors) @ self._opponent.T], -1)

    def _restore(self, codes: Tensor) -> list[Tensor]:
        change = codes * self._steps
        means, cholesky = move(self._base[0], self._base[1], change[:, :5], exact=False)
        return [means, cholesky, self._base[2] + change[:, 5:] @ self._opponent]

    def _moved(self, current: list[Tensor], speed: Tensor) -> list[Tensor]:
        step = _STEP * speed
        means, cholesky = move(current[0], current[1], step[:, :5].clamp(-_LARGEST, _LARGEST), exact=False)
        cholesky = cholesky.clamp(cholesky.new_tensor(LEAST_FACTOR), cholesky.new_tensor(MOST_FACTOR))
        return [means, cholesky, current[2] + step[:, 5:] @ self._opponent]

    def _downhill(self, current: list[Tensor]) -> Tensor:
        """Return Newton's steps of each number alone: of centre and factor in the Gaussian's frame, of colours."""
        means, cholesky, colors = (t.detach().requires_grad_() for t in current)
        size = (self.image.shape[1], self.image.shape[2])
        rendered = region_splat(means, cholesky, colors, self.region_ids, self.regions, size=size, cutoff=_DRAFT_CUTOFF)
        difference = rendered.detach() - self.image
        if self.objective is not None:
            difference = self.objective.apply(difference)
        slopes = torch.autograd.grad(rendered, (means, cholesky, colors), difference)
        local = torch.cat([local_gradient(current[1], *slopes[:2]), slopes[2] @ self._opponent.T], -1)
        narrow = current[1][:, ::2].clamp_min(_NARROW)
        area = (math.pi * narrow.prod(-1)).clamp_max(size[0] * size[1]) * self.weights()
        energy = (current[2].square().sum(-1) * area).clamp_min(_FAINT)
        curvature = torch.cat([self._curvature * energy[:, None], area[:, None].expand(-1, local.shape[1] - 5)], -1)
        # half the squared error, as its gradient is the difference
        steps = self._measure(current) / self._steps
        price = torch.full_like(steps[:, :1], 0.5 * self.price * _BITS / math.log(2))
        price[len(price) - self.born :] = 0.0
        slope = price * 2 / (steps.square() + _SOFT) / self._steps
        newton = (local + slope * steps) / (curvature + 0.5 * slope / self._steps)
        return -torch.cat([newton[:, :5].clamp(-_NEWTON, _NEWTON), newton[:, 5:]], -1)
