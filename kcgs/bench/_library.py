"""Scenes by today's calls of the library, until it returns and takes scenes everywhere."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from kcgs.fit import FitConfig
from kcgs.rate import compress as compress_parts
from kcgs.rate import fit_bytes as fit_bytes_parts
from kcgs.scene import Scene


def compress(scene: Scene, image: Tensor, **options: Any) -> bytes:
    """Compress."""
    return compress_parts(scene.field, image, scene.regions, **options)


def fit_bytes(image: Tensor, labels: Tensor | None, most: int, config: FitConfig) -> tuple[bytes, Scene]:
    """Fit to bytes."""
    made = fit_bytes_parts(image, labels, most, config=config)
    return made.data, Scene(made.result.field, made.result.regions)
