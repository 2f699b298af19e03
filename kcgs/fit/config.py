"""Settings of a fit, typed and range-checked, and the recipes: named TOML files of differences from the defaults."""

from __future__ import annotations

import math
import tomllib
from importlib.resources import files
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from kcgs.kernels import BACKENDS


class FitConfig(BaseModel):
    """Settings of a fit; the defaults are the paper's method.

    Convention: moments of the schedule are fractions of the iterations, so that 500 and 50,000 both make sense.

    Raises:
        ValueError: an unknown setting, or a value of the wrong type or out of range.

    Example:
        >>> FitConfig.from_recipe("gaussian-image", iterations=500).guidance
        False
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    # The model
    guidance: bool = Field(True, description="confine Gaussians to regions, where regions are given")
    clamp: bool = Field(False, description="clip the image to [0, 1] in training")
    softness: float = Field(0.0, ge=0.0, le=64.0, description="contour width in pixels; 0: the paper's rule")
    cutoff: float = Field(1e-4, ge=0.0, lt=1.0, description="weights below it are skipped")
    backend: str = Field("auto", description="kernel, as in region_splat")

    # The start
    init_sigma: float | None = Field(
        None, gt=0.0, description="pixels; None: half the spacing sqrt(H W / N), at least 1 pixel"
    )

    # Region ids
    warmup: bool = Field(True, description="read the ids again under the moving centres")
    refresh_every: float = Field(0.02, gt=0.0, le=1.0, description="fraction of the iterations between refreshes")
    refresh_until: float = Field(0.5, ge=0.0, le=1.0, description="fraction of the iterations, then frozen")

    # The descent
    loss: Literal["l1", "l2"] = "l1"
    optimizer: Literal["adam", "adan"] = "adam"
    learning_rate: float = Field(1e-3, gt=0.0, description="at `full_iterations`; see `effective_learning_rate`")
    full_iterations: int = Field(50_000, ge=1, description="the length that learning_rate is meant for")
    decay: float = Field(0.5, gt=0.0, le=1.0, description="factor on the learning rate at each decay")
    decay_every: float = Field(0.4, gt=0.0, le=1.0, description="fraction of the iterations between decays")

    # The end
    iterations: int = Field(50_000, ge=1)
    max_seconds: float | None = Field(None, gt=0.0, description="stop after this wall time")
    target_psnr: float | None = Field(None, gt=0.0, description="stop at this PSNR (dB)")
    history_points: int = Field(100, ge=1, description="about how many entries the history gets")

    def model_post_init(self, context: Any) -> None:
        """Check what a type cannot say."""
        if self.backend not in BACKENDS:
            raise ValueError(f"backend must be one of {', '.join(BACKENDS)}; got {self.backend!r}")

    @classmethod
    def from_recipe(cls, recipe: str, **overrides: Any) -> FitConfig:
        """Read a recipe by name and change some of its settings.

        Args:
            recipe: a name from :func:`available_recipes`.
            overrides: settings by name.

        Raises:
            ValueError: unknown recipe or setting, or a value out of range.
        """
        if recipe not in available_recipes():
            raise ValueError(f"recipe must be one of {', '.join(available_recipes())}; got {recipe!r}")
        settings = tomllib.loads((files("kcgs.recipes") / f"{recipe}.toml").read_text(encoding="utf-8"))
        try:
            return cls(**{**settings, **overrides})
        except ValidationError as error:
            raise ValueError(_one_line(error)) from error

    def effective_learning_rate(self) -> float:
        """Learning rate of this run: a shorter run takes larger steps, by the root of the ratio, up to twentyfold."""
        return self.learning_rate * min(20.0, math.sqrt(max(1.0, self.full_iterations / self.iterations)))


def available_recipes() -> list[str]:
    """Names of the recipes that come with the package, sorted.

    Example:
        >>> "paper" in available_recipes()
        True
    """
    return sorted(f.name.removesuffix(".toml") for f in files("kcgs.recipes").iterdir() if f.name.endswith(".toml"))


def _one_line(error: ValidationError) -> str:
    parts = [f"{'.'.join(map(str, e['loc'])) or 'config'}: {e['msg']}; got {e['input']!r}" for e in error.errors()]
    return "; ".join(parts)
