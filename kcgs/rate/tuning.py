"""Gaussians that descend on their error and their bits, and are then rounded a few at a time.

Gaussians overlap, so what rounding one of them does to the image its neighbours can partly undo, as long as they may
still move. So they are rounded a few at a time, shapes first and colours last, and those that are still free descend
meanwhile. A step is a gradient divided by the known curvature of the squared error (docs/format.md), with momentum.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcgs.codec.exact import Integers
from kcgs.codec.gaussians.quantize import Classes, Codes, Parameters, Quantizer
from kcgs.fitting.frame import area, move, newton_steps
from kcgs.fitting.objective import MsSsimObjective
from kcgs.functional import RegionMap, region_splat

from .bits import soft_bits

# a Gaussian whose whole energy is below this many times the distortion costs more bits than it saves: at the best rate
# a bit saves 2 ln 2 D for each number, and a Gaussian has about 30
_PAYING = 20.0
# what a bit must save, in units of the distortion: 2 ln 2 where nobody makes up for rounding; found by trial
_BIT = 0.9
# share of the iterations in which shapes are rounded; colours are in the rest; and when surplus Gaussians are left out
_SHAPES, _LOOKS = 0.65, (0.3, 0.65, 0.9)
_STEP, _MOMENTUM = 0.09, 0.9
# the largest step, in standard deviations and in log scale
_LARGEST = 0.2
_DRAFT_CUTOFF = 1e-3
# steps for which the slope of the bits is kept, and those between two times of rounding
_CHARGED, _GROUP = 4, 3


class Tuning:
    """Gaussians that show an image (C, H, W), on the CPU; `ids` are the positions of their regions' ids in the map."""

    def __init__(
        self,
        gaussians: Parameters,
        ids: Integers,
        image: Tensor,
        regions: RegionMap | None,
        quantizer: Quantizer,
        objective: MsSsimObjective | None,
    ) -> None:
        self.ids, self.image, self.regions, self.objective = ids, image, regions, objective
        self.quantizer, self._steps = quantizer, 0
        self._charge: Tensor | None = None  # [N, 3 + C] slopes of the bits' price, by factors and colours
        self._free = [torch.from_numpy(numbers).to(image) for numbers in gaussians]
        self._speed = torch.zeros(len(ids), 5 + gaussians.colors.shape[1]).to(image)
        # what the distortion counts in the error
        self._counts = float(self._weights(*self._free[:2]).mean())

    @property
    def gaussians(self) -> Parameters:
        """What the Gaussians are now, in float64."""
        return Parameters(*(numbers.double().numpy() for numbers in self._free))

    def drop(self) -> None:
        """Leave out the Gaussians that do not pay for their bits; one stays at least."""
        energy = self._energy()
        kept = energy >= _PAYING * self._counts * self.quantizer.distortion
        kept[energy.argmax()] = True
        self._keep(kept.numpy())

    def descend(self, iterations: int) -> None:
        """Move all Gaussians downhill, so many steps."""
        for _ in range(iterations):
            self._speed = _MOMENTUM * self._speed + self._downhill(*self._free)
            self._free = self._moved(self._free)

    def round(self, iterations: int, seed: int, excess: Callable[[Codes], int] | None = None) -> Codes:
        """Round everything in so many iterations, in an order of the seed; return the whole numbers.

        `excess` says how many Gaussians are too many; the weakest go, early enough for others to make up for them.
        """
        generator = torch.Generator().manual_seed(seed)
        turn = torch.rand(2, len(self.ids), generator=generator).to(self.image)
        classes = self.quantizer.classify(self.gaussians)
        looks = [*_LOOKS, math.inf]
        for iteration in range(iterations):
            share = iteration / iterations
            if iteration % _GROUP == 0:
                if excess is not None and share >= looks[0]:
                    looks.pop(0)
                    kept = self._leave_out(excess(self.quantizer.quantize(self.gaussians, classes)))
                    turn, classes = turn[:, kept], Classes(*(numbers[kept] for numbers in classes))
                rounded = self.quantizer.restore(self.quantizer.quantize(self.gaussians, classes))
                shaped, colored = turn[0] < share / _SHAPES, turn[1] < (share - _SHAPES) / (1 - _SHAPES)
            self._step(rounded, shaped[:, None], colored[:, None])
        while True:
            codes = self.quantizer.quantize(self.gaussians, classes)
            if excess is None or not (count := excess(codes)) or len(self.ids) == 1:
                return codes
            kept = self._leave_out(count)
            classes = Classes(*(numbers[kept] for numbers in classes))

    def _leave_out(self, count: int) -> NDArray[np.bool_]:
        """Leave out so many of the weakest, but for the last; return which stay."""
        rank = self._energy().argsort(stable=True).argsort().numpy()
        return self._keep(rank >= min(count, len(rank) - 1))

    def _keep(self, kept: NDArray[np.bool_]) -> NDArray[np.bool_]:
        self.ids, index = self.ids[kept], torch.from_numpy(kept)
        self._free, self._speed = [numbers[index] for numbers in self._free], self._speed[index]
        self._charge = None
        return kept

    def _step(self, rounded: Parameters, shaped: Tensor, colored: Tensor) -> None:
        """Move what is free, against the render of what is rounded and what is not."""
        fixed, restored = (shaped, shaped, colored), (torch.from_numpy(t).to(self.image) for t in rounded)
        current = [torch.where(fix, r, f) for fix, r, f in zip(fixed, restored, self._free, strict=True)]
        downhill = self._downhill(*current)
        stopped = torch.cat([shaped.expand(-1, 5), colored.expand(-1, downhill.shape[1] - 5)], -1)
        self._speed = torch.where(stopped, 0.0, _MOMENTUM * self._speed + downhill)
        moved = self._moved(current)
        self._free = [torch.where(fix, f, m) for fix, f, m in zip(fixed, self._free, moved, strict=True)]

    def _moved(self, current: list[Tensor]) -> list[Tensor]:
        step = _STEP * self._speed
        means, cholesky = move(current[0], current[1], step[:, :5].clamp(-_LARGEST, _LARGEST), exact=False)
        return [means, cholesky, current[2] + step[:, 5:]]

    def _downhill(self, means: Tensor, cholesky: Tensor, colors: Tensor) -> Tensor:
        """Return Newton's steps of each number alone: of centre and factor in the Gaussian's frame, of colours."""
        if self._charge is None or self._steps % _CHARGED == 0:
            factors, c = (t.detach().requires_grad_() for t in (cholesky, colors))
            # half the squared error, as its gradient is the difference
            price = 0.5 * _BIT * self._counts * self.quantizer.distortion
            bits = price * soft_bits(factors, c, self.quantizer).sum()
            self._charge = torch.cat(torch.autograd.grad(bits, (factors, c)), -1)
        self._steps += 1
        charge, size = self._charge, self.quantizer.size
        x, factors, c = (t.detach().requires_grad_() for t in (means, cholesky, colors))
        render = region_splat(x, factors, c, self._region_ids, self.regions, size=size, cutoff=_DRAFT_CUTOFF)
        difference = render.detach() - self.image
        if self.objective is not None:
            difference = self.objective.apply(difference)
        slopes = torch.autograd.grad(render, (x, factors, c), difference)
        slopes = slopes[0], slopes[1] + charge[:, :3], slopes[2] + charge[:, 3:]
        areas = area(cholesky).clamp_max(size[0] * size[1]) * self._weights(means, cholesky)
        return newton_steps(cholesky, colors, slopes, areas)

    def _energy(self) -> Tensor:
        """Return what the objective loses without each Gaussian, (N,)."""
        means, cholesky, colors = (numbers.double() for numbers in self._free)
        area = (math.pi * cholesky[:, 0] * cholesky[:, 2]).clamp_max(math.prod(self.quantizer.size))
        return self._weights(means, cholesky) * (colors.square().sum(-1) * area)

    def _weights(self, means: Tensor, cholesky: Tensor) -> Tensor:
        """Return what the squared error of Gaussians counts in the objective, (N,)."""
        return torch.ones_like(means[:, 0]) if self.objective is None else self.objective.weigh(means, cholesky)

    @property
    def _region_ids(self) -> Tensor | None:
        return None if self.regions is None else self.regions.ids[torch.from_numpy(self.ids)]
