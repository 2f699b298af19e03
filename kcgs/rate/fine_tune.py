r"""Rounding that the rest makes up for.

Gaussians overlap, so what rounding one of them does to the picture its neighbours can partly undo, as long as they may
still move. So they are rounded a few at a time, shapes first and colours last, and those that are still free descend
meanwhile. A step is a gradient divided by the known curvature of the squared error (docs/format.md), with
momentum; there is nothing to adapt.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcgs.codec.gaussians.quantize import Codes, Parameters, Quantizer
from kcgs.functional import RegionMap, region_splat

# share of the iterations in which shapes are rounded; colours are in the rest
_SHAPES = 0.65
_STEP, _MOMENTUM = 0.09, 0.9
# the largest step, in standard deviations and in log scale
_LARGEST = 0.2
# energies below it have next to no curvature: steps are as if they had this
_FAINT = 1e-2
_DRAFT_CUTOFF = 1e-3


class FineTuning:
    """Gaussians on their way to whole numbers.

    Args:
        gaussians: in float64.
        region_ids: their regions.
        image: (C, H, W) that they are to show.
        regions: the map to render with.
        quantizer: says what they may be rounded to.
        seed: of the order in which they are rounded.
    """

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
        rounded = [torch.from_numpy(t).to(self.image) for t in self.quantizer.restore(self.codes())]
        held = (shaped, shaped, colored)
        drawn = [torch.where(hold, r, f) for hold, r, f in zip(held, rounded, self.free, strict=True)]
        downhill = torch.cat(self._downhill(*drawn), -1)
        self.speed = torch.where(
            torch.cat([shaped.expand(-1, 5), colored.expand(-1, downhill.shape[1] - 5)], -1),
            0.0,
            _MOMENTUM * self.speed + downhill,
        )
        move = _STEP * self.speed
        d1, d2, k11, k21, k22 = move[:, :5].clamp(-_LARGEST, _LARGEST).unbind(-1)
        l11, l21, l22 = drawn[1].unbind(-1)
        means = drawn[0] + torch.stack([l11 * d1, l21 * d1 + l22 * d2], -1)
        stretch = torch.exp(k11)
        cholesky = torch.stack([l11 * stretch, l21 * stretch + l22 * k21, l22 * torch.exp(k22)], -1)
        moved = means, cholesky, drawn[2] + move[:, 5:]
        self.free = [torch.where(hold, f, m) for hold, f, m in zip(held, self.free, moved, strict=True)]

    def _downhill(self, means: Tensor, cholesky: Tensor, colors: Tensor) -> tuple[Tensor, Tensor]:
        """Return Newton's steps of each number alone: of centre and factor in the Gaussian's frame, of colours."""
        leaves = [t.detach().requires_grad_() for t in (means, cholesky, colors)]
        x, factors, c = leaves
        size = self.quantizer.size
        render = region_splat(x, factors, c, self.region_ids, self.regions, size=size, cutoff=_DRAFT_CUTOFF)
        render.backward(render.detach() - self.image)
        (gx, gy), (g11, g21, g22) = self._gradient(x).unbind(-1), self._gradient(factors).unbind(-1)
        l11, l21, l22 = cholesky.unbind(-1)
        area = (math.pi * l11 * l22).clamp_max(size[0] * size[1])
        energy = (colors.square().sum(-1) * area).clamp_min(_FAINT)
        # half the second derivatives of the squared error, as the gradient is half the first
        frame = [
            (l11 * gx + l21 * gy) / (0.5 * energy),
            l22 * gy / (0.5 * energy),
            (l11 * g11 + l21 * g21) / (0.75 * energy),
            l22 * g21 / (0.25 * energy),
            l22 * g22 / (0.75 * energy),
        ]
        shape = torch.stack(frame, -1).clamp(-0.3, 0.3)
        return -shape, -(self._gradient(c) / area[:, None])

    @staticmethod
    def _gradient(leaf: Tensor) -> Tensor:
        assert leaf.grad is not None
        return leaf.grad
