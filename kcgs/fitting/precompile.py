"""Compilation before the first fit of a process."""

from __future__ import annotations

from functools import lru_cache

import torch

from .config import FitConfig
from .loop import fit


@lru_cache(maxsize=64)
def precompile(config: FitConfig) -> None:
    """Compile and load what fits of these settings need, so that no fit's clock counts it."""
    ramp = torch.linspace(0.0, 1.0, 96)
    image = torch.stack([ramp.expand(64, 96), 1 - ramp.expand(64, 96), (8 * ramp).sin().square().expand(64, 96)])
    labels = (ramp > 0.6).long().expand(64, 96).contiguous()
    short = config.model_copy(update={"iterations": min(config.usual_iterations, 20), "max_seconds": None})
    fit(image, labels, 24, recipe=short)
