"""Image-GS's densification."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from kcgs.fitting.events import Densify
from kcgs.fitting.initial import initial_sigma
from kcgs.fitting.state import FitState
from kcgs.functional import lookup_regions
from kcgs.nn import GaussianField

from .sampling import sample_pixels


@dataclass(frozen=True)
class DensifyAtLargestError(Densify):
    """Add Gaussians at pixels that are sampled in proportion to their squared error, as Image-GS does."""

    steps: int = 4
    end: float = 0.2
    surplus: float = 0.0

    def add(self, state: FitState, count: int) -> None:
        """Add round Gaussians of half the spacing, of the colour that their pixel lacks."""
        if count <= 0:
            return
        problem, (_, width) = state.problem, state.problem.size
        residual = state.objective.residual(state.render().detach()).error
        errors = residual.square().mean(1).flatten(1).double().cpu().numpy() + 1e-12
        seed = (problem.seed, state.num_additions)
        samples = np.stack([sample_pixels(error, count, np.random.default_rng(seed)) for error in errors])
        pixels = torch.from_numpy(samples).to(residual.device)
        means = torch.stack([pixels % width, pixels // width], -1).to(residual.dtype) + 0.5
        sigma = torch.full_like(means[..., 0], initial_sigma(problem.size, problem.num_gaussians))
        ids = None if state.regions is None else lookup_regions(means, state.regions.labels)
        cholesky = torch.stack([sigma, torch.zeros_like(sigma), sigma], -1)
        places = pixels[:, None].expand(-1, residual.shape[1], -1)
        colors = residual.flatten(2).gather(2, places).mT
        added = GaussianField(means, cholesky, colors, ids, size=problem.size)
        state.optimizer.append(state.field, added)
