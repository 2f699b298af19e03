"""Rounding that the rest makes up for.

Gaussians overlap, so what rounding one of them does to the image its neighbours can partly undo, as long as they may
still move. So they are rounded a few at a time, shapes first and colours last, and those that are still free descend
meanwhile. A step is a gradient divided by the known curvature of the squared error (docs/format.md), with momentum.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcgs.codec.gaussians.quantize import Codes, Parameters, Quantizer
from kcgs.fit.frame import local_gradient, move
from kcgs.functional import RegionMap, region_splat

# share of the iterations in which shapes are rounded; colours are in the rest
_SHAPES = 0.65
_STEP, _MOMENTUM = 0.09, 0.9
# the largest step, in standard deviations and in log scale; and the largest share of Newton's
_LARGEST, _NEWTON = 0.2, 0.3
# energies below it have next to no curvature: steps are as if they had this
_FAINT = 1e-2
# half the second derivatives of the squared error by a step in a Gaussian's frame, in units of its energy
_CURVATURE = (0.5, 0.5, 0.75, 0.25, 0.75)
_DRAFT_CUTOFF = 1e-3


class FineTuning:
    """Gaussians (float64) that are rounded a few at a time, in an order of the seed, to show an image (C, H, W)."""

    def __init__(
        self,
        gaussians: Parameters,
        region_ids: Tensor | None,
        image: Tensor,
        regions: RegionMap | None,
        quantizer: Quantizer,
        seed: int = 0,
    ) -> None:
        self.region_ids, self.image, self.regions, self.quantizer = region_ids, image, regions, quantizer
        self.classes = quantizer.classify(gaussians)
        self.free = [torch.from_numpy(numbers).to(image) for numbers in gaussians]
        count, channels = gaussians.colors.shape
        generator = torch.Generator().manual_seed(seed)
        self.turn = torch.rand(2, count, generator=generator).to(image)
        self.speed = torch.zeros(count, 5 + channels).to(image)

    def run(self, iterations: int) -> Codes:
        """Round everything in so many iterations, and return the whole numbers."""
        for iteration in range(iterations):
            share = iteration / iterations
            shaped = self.turn[0] < share / _SHAPES
            colored = self.turn[1] < (share - _SHAPES) / (1 - _SHAPES)
            self._step(shaped[:, None], colored[:, None])
        return self.codes()

    def codes(self) -> Codes:
        """Return what the Gaussians round to now."""
        gaussians = Parameters(*(numbers.double().numpy() for numbers in self.free))
        return self.quantizer.quantize(gaussians, self.classes)

    def _step(self, shaped: Tensor, colored: Tensor) -> None:
        """Move what is free, against the render of what is rounded and what is not."""
        rounded = [torch.from_numpy(t).to(self.image) for t in self.quantizer.restore(self.codes())]
        fixed = (shaped, shaped, colored)
        current = [torch.where(fix, r, f) for fix, r, f in zip(fixed, rounded, self.free, strict=True)]
        downhill = self._downhill(*current)
        stopped = torch.cat([shaped.expand(-1, 5), colored.expand(-1, downhill.shape[1] - 5)], -1)
        self.speed = torch.where(stopped, 0.0, _MOMENTUM * self.speed + downhill)
        step = _STEP * self.speed
        means, cholesky = move(current[0], current[1], step[:, :5].clamp(-_LARGEST, _LARGEST), exact=False)
        moved = means, cholesky, current[2] + step[:, 5:]
        self.free = [torch.where(fix, f, m) for fix, f, m in zip(fixed, self.free, moved, strict=True)]

    def _downhill(self, means: Tensor, cholesky: Tensor, colors: Tensor) -> Tensor:
        """Return Newton's steps of each number alone: of centre and factor in the Gaussian's frame, of colours."""
        size = self.quantizer.size
        x, factors, c = (t.detach().requires_grad_() for t in (means, cholesky, colors))
        render = region_splat(x, factors, c, self.region_ids, self.regions, size=size, cutoff=_DRAFT_CUTOFF)
        gradients = torch.autograd.grad(render, (x, factors, c), render.detach() - self.image)
        area = (math.pi * cholesky[:, 0] * cholesky[:, 2]).clamp_max(size[0] * size[1])
        energy = (colors.square().sum(-1) * area).clamp_min(_FAINT)
        curvature = torch.tensor(_CURVATURE).to(energy) * energy[:, None]
        shape = (local_gradient(cholesky, *gradients[:2]) / curvature).clamp(-_NEWTON, _NEWTON)
        return -torch.cat([shape, gradients[2] / area[:, None]], -1)
