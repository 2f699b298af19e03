"""Image-GS, on the hooks that every user of `kcgs.fit` has.

The renderer is that of kcgs: a plain sum, where the publication blends the ten nearest Gaussians with normalised
weights. It is the same method, not the same numbers.

Source: Zhang et al., "Image-GS: Content-Adaptive Image Representation via 2D Gaussians", 2025.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import sobel
from torch import Tensor

from kcgs import GaussianField, RegionMap
from kcgs.fitting import FitState
from kcgs.functional import ssim
from kcgs.optim import ReparametrizedOptimizer

# share of the gradient in the density of the first centres; the rest is uniform
_GRADIENT_SHARE = 0.7
# sum of the weights of Gaussians of half the spacing at a pixel
_OVERLAP = math.pi / 2
# pixels: thinner Gaussians would fall between the pixel centres, at the start and in the descent
_MIN_FIRST_SIGMA = 0.5
_MIN_SIGMA = 0.1
# weight of 1 - SSIM in the loss; the mean absolute error has the weight 1
_SSIM_WEIGHT = 0.1


def gradient_field(images: Tensor, num_gaussians: int, regions: RegionMap | None, seed: int) -> GaussianField:
    """Sample centres where images (B, C, H, W) change: 0.7 Sobel gradient magnitude + 0.3 uniform."""
    field = GaussianField.stack([_field_of_image(image, num_gaussians, seed) for image in images])
    return field if regions is None else field.assign_regions(regions)


def _field_of_image(image: Tensor, num_gaussians: int, seed: int) -> GaussianField:
    planes = image.detach().cpu().double().numpy()
    slope = np.sqrt(sum(sobel(planes, axis) ** 2 for axis in (1, 2)).mean(0)).ravel()
    share = _GRADIENT_SHARE if slope.any() else 0.0
    density = share * slope / max(slope.sum(), 1e-300) + (1 - share) / slope.size
    pixels = _sample_pixels(density, num_gaussians, np.random.default_rng(seed))
    centres = np.stack([pixels % planes.shape[2], pixels // planes.shape[2]], -1) + 0.5
    sigma = np.maximum(0.5 / np.sqrt(num_gaussians * density[pixels]), _MIN_FIRST_SIGMA)
    colors = planes.reshape(len(planes), -1).T[pixels] / _OVERLAP
    cholesky = np.stack([sigma, np.zeros_like(sigma), sigma], -1)
    tensors = (torch.from_numpy(values).to(image) for values in (centres, cholesky, colors))
    return GaussianField(*tensors, size=(image.shape[1], image.shape[2]))


def _sample_pixels(weights: NDArray[np.floating], count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return `count` different positions, sampled in proportion to weight, in order."""
    if count == len(weights):
        return np.arange(count)
    # the first arrivals of Poisson clocks of these rates
    arrivals = rng.standard_exponential(len(weights)) / weights
    return np.sort(np.argpartition(arrivals, count)[:count])


class DensifyAtLargestError:
    """Adds Gaussians at pixels that are sampled in proportion to their squared error, until there are N."""

    steps = 4
    begin = 0.05
    """Share of the fit at the first addition."""
    end = 0.2
    """Share of the fit at the last addition."""

    @torch.no_grad()
    def act(self, state: FitState) -> None:
        """Add Gaussians, once a state was measured, where there are fewer than at this share of the fit."""
        if not state.history or state.progress < self.begin:
            return
        first, final = state.num_initial, state.problem.num_gaussians
        share = min(1.0, (state.progress - self.begin) / (self.end - self.begin))
        target = first + round((final - first) * (1 + int(share * (self.steps - 1))) / self.steps)
        if target > state.num_gaussians:
            state.num_additions += 1
            state.optimizer.append(state.field, self._sample(state, target - state.num_gaussians))

    def _sample(self, state: FitState, count: int) -> GaussianField:
        """Return round Gaussians of half the spacing, of the colour that their pixel lacks."""
        problem, (height, width) = state.problem, state.problem.size
        residual = problem.target - state.render()
        errors = residual.square().mean(1).flatten(1).double().cpu().numpy() + 1e-12
        seed = (problem.seed, state.num_additions)
        samples = np.stack([_sample_pixels(error, count, np.random.default_rng(seed)) for error in errors])
        pixels = torch.from_numpy(samples).to(residual.device)
        means = torch.stack([pixels % width, pixels // width], -1).to(residual.dtype) + 0.5
        sigma = torch.full_like(means[..., 0], max(1.0, 0.5 * math.sqrt(height * width / problem.num_gaussians)))
        cholesky = torch.stack([sigma, torch.zeros_like(sigma), sigma], -1)
        colors = residual.flatten(2).gather(2, pixels[:, None].expand(-1, residual.shape[1], -1)).mT
        added = GaussianField(means, cholesky, colors, size=problem.size)
        return added if state.regions is None else added.assign_regions(state.regions)


class ImageGSAdam(ReparametrizedOptimizer):
    """Adam on centres in units of the image, inverse scales in 1 / pixel, rotation angles, and colours.

    Learning rates are constant over the fit. They are ours, since the publication's are for another renderer.
    """

    learning_rates = (5e-4, 2e-3, 2e-3, 5e-3)

    def __init__(self, field: GaussianField) -> None:
        height, width = field.size
        self.extent = field.means.detach().new_tensor([width, height])
        self.limit = math.hypot(height, width)
        super().__init__(field, self.learning_rates, torch.optim.Adam)

    def encode(self, field: GaussianField) -> list[Tensor]:
        """Return centres, inverse scales, angles and colours; round Gaussians have angle 0."""
        means, cholesky, colors = field.means.detach(), field.cholesky.detach(), field.colors.detach()
        l11, l21, l22 = cholesky.unbind(-1)
        factor = torch.stack([l11, torch.zeros_like(l11), l21, l22], -1).unflatten(-1, (2, 2))
        axes, scales, _ = torch.linalg.svd(factor)
        angle = torch.atan2(axes[..., 1, 0], axes[..., 0, 0])
        return [means / self.extent, 1 / scales, angle[..., None], colors]

    def decode(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return means, cholesky, colors."""
        centres, inverse_scales, angles, colors = self.parameters
        s1, s2 = (1 / inverse_scales.abs().clamp(1 / self.limit, 1 / _MIN_SIGMA)).unbind(-1)
        cos, sin = torch.cos(angles[..., 0]), torch.sin(angles[..., 0])
        # R diag(s1, s2)^2 R^T = L L^T
        l11 = torch.sqrt((cos * s1) ** 2 + (sin * s2) ** 2)
        l21 = cos * sin * (s1**2 - s2**2) / l11
        return centres * self.extent, torch.stack([l11, l21, s1 * s2 / l11], -1), colors


def l1_and_ssim(image: Tensor) -> Callable[[Tensor], Tensor]:
    """Return the published loss of a render, (1, C, H, W), of an image (C, H, W): L1 + 0.1 (1 - SSIM)."""
    return lambda render: (render - image).abs().mean() + _SSIM_WEIGHT * (1 - ssim(render, image[None]).mean())


# by the names that they have in jobs, which are plain values
OBJECTS: dict[str, Any] = {"gradient": gradient_field, "largest-error": DensifyAtLargestError(), "adam": ImageGSAdam}
# `fit(image, **{name: OBJECTS.get(value, value) for name, value in SETTINGS.items()}, objective=l1_and_ssim(image))`
SETTINGS: dict[str, Any] = {
    "guidance": False, "clamp": False, "initializer": "gradient", "densify": "largest-error", "densify_from": 0.5,
    "move_contours": False, "merge_regions": False, "optimizer": "adam", "prune": 0.0, "iterations": 10_000,
}  # fmt: skip
