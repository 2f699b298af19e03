"""How a region moved between two frames: an affine motion, by Gauss-Newton steps on the images, from coarse to fine."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, pad

# halvings of the images; steps at each size; pixels that a step looks at
_LEVELS, _STEPS, _SAMPLES = 4, 6, 12000
# places tried about none at the coarsest size, in its pixels; and pixels of a region that one size needs
_REACH, _FEWEST = 3, 30
# errors above it count less and less, for what is uncovered or moves otherwise has no say
_TYPICAL = 0.06
# what a pixel of motion at the coarsest size must gain: of equal motions the shorter one is chosen
_MOVE_COST, _RIDGE = 1e-4, 1e-4
# share of a region that must stay inside
_INSIDE = 0.3


def register(source: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """Find where a region went.

    Minimises a robust sum of squares of the differences between the images (Geman and McClure's), over the region's
    pixels, by the method of Lucas and Kanade (1981), first for shifts, then for affine motions, on ever larger images.

    Args:
        source: (C, H, W), the frame before.
        target: (C, H, W), the frame.
        mask: (H, W) bool, the region in `source`.

    Returns:
        (2, 3) float64: point p of the source, in pixels, is at A p + b in the target. No motion, where the region is
        too small to tell.
    """
    levels = min(_LEVELS, max(0, int(math.log2(min(mask.shape) / 8)))) if min(mask.shape) >= 8 else 0
    sources, targets, masks = (_pyramid(t, levels) for t in (source, target, mask[None].to(source)))
    motion = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    searched = False
    for level in range(levels, -1, -1):
        view = _View(sources[level], targets[level], masks[level][0], mask.shape)
        if view.count < _FEWEST:
            continue
        if not searched:
            motion, searched = view.search(motion), True
            motion = view.descend(motion, affine=False)
        motion = view.descend(motion, affine=True)
    return motion.double()


class _View:
    """Two frames at one size, and the pixels of a region; coordinates are those of the full size."""

    def __init__(self, source: Tensor, target: Tensor, mask: Tensor, size: Any) -> None:
        self.size, self.target = size, target
        self.step_x, self.step_y = size[1] / source.shape[2], size[0] / source.shape[1]
        places = (mask > _INSIDE).nonzero()
        self.count = len(places)
        if self.count > _SAMPLES:
            places = places[torch.linspace(0, self.count - 1, _SAMPLES).long()]
        rows, columns = places.unbind(-1)
        self.x, self.y = (columns + 0.5) * self.step_x, (rows + 0.5) * self.step_y
        self.values = source[:, rows, columns]
        wide = pad(target[None], (1, 1, 1, 1), "replicate")[0]
        self.slopes = torch.cat([
            (wide[:, 1:-1, 2:] - wide[:, 1:-1, :-2]) / (2 * self.step_x),
            (wide[:, 2:, 1:-1] - wide[:, :-2, 1:-1]) / (2 * self.step_y),
        ])  # fmt: skip

    def search(self, motion: Tensor) -> Tensor:
        """Return the best of some shifts."""
        best, cost = motion, self._cost(motion)
        for dy in range(-_REACH, _REACH + 1):
            for dx in range(-_REACH, _REACH + 1):
                tried = motion.clone()
                tried[0, 2] += dx * self.step_x
                tried[1, 2] += dy * self.step_y
                found = self._cost(tried) + _MOVE_COST * (abs(dx) + abs(dy))
                if found < cost:
                    best, cost = tried, found
        return best

    def descend(self, motion: Tensor, *, affine: bool) -> Tensor:
        """Go downhill as long as that helps."""
        cx, cy = self.x.mean(), self.y.mean()
        radius = ((self.x - cx) ** 2 + (self.y - cy) ** 2).mean().sqrt().clamp_min(1.0)
        one = torch.ones_like(self.x)
        basis = torch.stack([one, (self.x - cx) / radius, (self.y - cy) / radius] if affine else [one])
        cost = self._cost(motion)
        for _ in range(_STEPS):
            error, weight, x, y = self._errors(motion)
            gx, gy = self._sample(self.slopes, x, y).chunk(2)
            slopes = torch.cat([basis[:, None] * gx, basis[:, None] * gy])
            matrix = torch.einsum("pcn,qcn,n->pq", slopes, slopes, weight)
            matrix += _RIDGE * torch.eye(len(matrix)) * (matrix.diagonal().mean() + 1e-12)
            step = -torch.linalg.solve(matrix, torch.einsum("pcn,cn,n->p", slopes, error, weight))
            moved = motion.clone()
            for axis, part in enumerate(step.chunk(2)):
                linear = part[1:] / radius if affine else part.new_zeros(2)
                moved[axis, :2] += linear
                moved[axis, 2] += part[0] - linear[0] * cx - linear[1] * cy
            found = self._cost(moved)
            if not found < cost:
                break
            motion, cost = moved, found
        return motion

    def _cost(self, motion: Tensor) -> float:
        error, _, x, y = self._errors(motion)
        square, inside = error.square().sum(0), self._inside(x, y)
        if inside.sum() < _INSIDE * len(inside):
            return math.inf
        return float((square / (square + 3 * _TYPICAL**2) * inside).sum() / inside.sum())

    def _errors(self, motion: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        x = motion[0, 0] * self.x + motion[0, 1] * self.y + motion[0, 2]
        y = motion[1, 0] * self.x + motion[1, 1] * self.y + motion[1, 2]
        error = self._sample(self.target, x, y) - self.values
        weight = self._inside(x, y) / (1 + error.square().sum(0) / (3 * _TYPICAL**2)) ** 2
        return error, weight, x, y

    def _inside(self, x: Tensor, y: Tensor) -> Tensor:
        inside: Tensor = (x > 0) & (y > 0) & (x < self.size[1]) & (y < self.size[0])
        return inside.to(x)

    def _sample(self, image: Tensor, x: Tensor, y: Tensor) -> Tensor:
        grid = torch.stack([2 * x / self.size[1] - 1, 2 * y / self.size[0] - 1], -1)[None, None]
        found: Tensor = grid_sample(image[None], grid, "bilinear", "border", align_corners=False)[0, :, 0]
        return found


def _pyramid(image: Tensor, levels: int) -> list[Tensor]:
    images = [image]
    for _ in range(levels):
        images.append(avg_pool2d(images[-1][None], 2, ceil_mode=True, count_include_pad=False)[0])
    return images
