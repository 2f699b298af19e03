"""Settings of a fit, typed and range-checked, and the recipes: named TOML files of differences from the defaults."""

from __future__ import annotations

import math
import tomllib
from importlib.resources import files
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from kcgs.functional.regions import MAX_SOFTNESS
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
    clamp: bool | Literal["auto"] = Field(
        False, description="clip the image to [0, 1] in training; auto: if a quarter of its values are 0 or 1"
    )
    softness: float | Literal["auto"] = Field(
        0.0,
        description="contour width in pixels, 0 to 64, of maps that have none; auto: chosen for each pair of regions",
    )
    cutoff: float = Field(1e-4, ge=0.0, lt=1.0, description="weights below it are skipped")
    draft_cutoff: float | None = Field(
        None, ge=0.0, lt=1.0, description="of the first 85 % of a fit that has no target; None: cutoff"
    )
    backend: str = Field("auto", description="kernel, as in region_splat")

    # The start
    initializer: Literal["random", "gradient", "kmeans"] = "random"
    init_sigma: float | None = Field(
        None, gt=0.0, description="pixels, for random starts; None: half the spacing sqrt(H W / N), at least 1 pixel"
    )

    # Growth
    grow_from: float = Field(1.0, gt=0.0, le=1.0, description="fraction of N alive at the start; 1: no growth")
    grow_steps: int = Field(10, ge=1, description="how often Gaussians are added")
    grow_between: tuple[float, float] = Field((0.05, 0.5), description="fractions of the fit")

    # Region ids
    warmup: bool = Field(True, description="read the ids again under the moving centres")
    refresh_every: float = Field(0.02, gt=0.0, le=1.0, description="fraction of the iterations between refreshes")
    refresh_until: float = Field(0.5, ge=0.0, le=1.0, description="fraction of the iterations, then frozen")

    # Contours
    refine: bool = Field(False, description="move the contours as the fit goes")
    max_move: float | Literal["any"] = Field(
        3.0, description="how far a contour may move from the given map, in pixels, at least 1; any: as far as it likes"
    )
    contour_price: float = Field(0.003, ge=0.0, description="squared error that a pixel of contour must save")
    contour_rise: float = Field(
        1.5,
        ge=1.0,
        description="factor by which a moved contour may raise the squared error about it, for Gaussians adapt to it; "
        "while they are added: later moves must lower it",
    )
    release: bool = Field(False, description="let regions go where a trial says that they do not help")

    # The descent
    loss: Literal["l1", "l2"] = "l1"
    optimizer: Literal["adam", "adan", "frame"] = Field("adam", description="frame: Adam in each Gaussian's own frame")
    learning_rate: float = Field(
        1e-3,
        gt=0.0,
        description="of frame as it is; of adam and adan at `full_iterations`, see `effective_learning_rate`",
    )
    color_rate: float = Field(0.03, gt=0.0, description="of the colours, for optimizer 'frame'")
    betas: tuple[float, float] = Field((0.9, 0.99), description="decay of the two averages, for optimizer 'frame'")
    full_iterations: int = Field(50_000, ge=1, description="the length that learning_rate is meant for")
    schedule: Literal["step", "cosine"] = "step"
    decay: float = Field(0.5, gt=0.0, le=1.0, description="step: factor at each decay; cosine: factor at the end")
    decay_every: float = Field(0.4, gt=0.0, le=1.0, description="fraction of the iterations between decays")

    # The end
    prune: float = Field(0.0, ge=0.0, description="remove Gaussians that change no pixel by more; 0: none")
    polish: bool = Field(False, description="finish flat scenes of few Gaussians by least squares")
    iterations: int = Field(50_000, ge=1)
    max_seconds: float | None = Field(None, gt=0.0, description="stop after this wall time; the schedule adapts to it")
    target_psnr: float | None = Field(None, gt=0.0, description="stop at this PSNR (dB)")
    history_points: int = Field(100, ge=1, description="about how many entries the history gets")

    def model_post_init(self, context: Any) -> None:
        """Check what a type cannot say."""
        if self.backend not in BACKENDS:
            raise ValueError(f"backend must be one of {', '.join(BACKENDS)}; got {self.backend!r}")
        if self.softness != "auto" and not 0.0 <= self.softness <= MAX_SOFTNESS:
            raise ValueError(f"softness must be 'auto' or in [0, {MAX_SOFTNESS:g}] pixels; got {self.softness!r}")
        if self.max_move != "any" and self.max_move < 1.0:
            raise ValueError(f"max_move must be 'any' or at least 1 pixel; got {self.max_move!r}")
        if self.grow_from < 1.0 and self.optimizer != "frame":
            raise ValueError(f"grow_from below 1 needs optimizer 'frame'; got {self.optimizer!r}")
        if not 0.0 <= self.grow_between[0] <= self.grow_between[1] <= 1.0:
            raise ValueError(f"grow_between must be two fractions in order; got {self.grow_between!r}")
        if not all(0.0 <= beta < 1.0 for beta in self.betas):
            raise ValueError(f"betas must be in [0, 1); got {self.betas!r}")

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
