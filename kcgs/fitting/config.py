"""Settings of a fit, typed and range-checked, and the recipes: named TOML files of differences from the defaults."""

from __future__ import annotations

import math
import tomllib
from difflib import get_close_matches
from importlib.resources import files
from typing import TYPE_CHECKING, Any, Literal, cast

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from kcgs import _names_0_3
from kcgs._objectives import ObjectiveName, Purpose, check_objective, objective_for
from kcgs._repr import shorten
from kcgs.errors import InvalidArgument, InvalidArgumentType
from kcgs.kernels import BACKENDS
from kcgs.maps import MAX_SOFTNESS

# iterations of a fit where neither `iterations` nor `max_seconds` is set
_USUAL_ITERATIONS = 700


class FitConfig(BaseModel):
    """Settings of a fit; the defaults are the recipe `best`.

    Convention: all values are numbers, bools, strings or None. Functions of your own are arguments of
    :func:`kcgs.fit`. Points in time are fractions of the fit, so that they fit 500 iterations as well as 50,000. Other
    parameters of an event or an optimizer are fields of its class.

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
        "auto",
        description="clip the render to [0, 1] in training; auto: only where the image is 0 or 1, if a quarter of its "
        "values are",
    )
    softness: float | Literal["auto"] = Field(
        "auto",
        description="width of contours in pixels, 0 to 64, for maps without softness; auto: chosen for each pair of "
        "regions",
    )
    cutoff: float = Field(1e-4, ge=0.0, lt=1.0, description="weights below it are skipped")
    backend: str = Field("auto", description="kernel, as in region_splat")

    # The Gaussians
    initializer: Literal["uniform", "random"] = Field(
        "uniform",
        description="where the first centres are; uniform: anywhere, with the image's colours; random: anywhere, with "
        "random colours",
    )
    densify_from: float = Field(0.01, gt=0.0, le=1.0, description="fraction of N at the start; the rest is added later")
    warmup: bool = Field(
        False, description="in the first half of the iterations, Gaussians take the region ids under their centres"
    )
    prune: float = Field(
        1e-3,
        ge=0.0,
        description="at the end, remove Gaussians that change no value of the image by more than this; 0: none",
    )

    # Contours
    move_contours: bool = Field(True, description="let contours leave the user's map")
    max_move: float | Literal["any"] = Field(
        3.0,
        description="how far a contour may move from the user's map, in pixels, at least 1; any: no limit",
    )
    contour_cost: float = Field(0.003, ge=0.0, description="squared error that a pixel of contour must save")
    merge_regions: bool = Field(
        True, description="merge the most similar regions if there are more regions than Gaussians"
    )

    # The descent
    objective: ObjectiveName | None = Field(
        None,
        description="what is lowered: l2, the squared error; l1; ms-ssim, what MS-SSIM lacks. None: l2, for a file of "
        "a size ms-ssim. Files and videos take l2 and ms-ssim",
    )
    optimizer: Literal["gaussian-adam", "adan"] = Field(
        "gaussian-adam",
        description="gaussian-adam: Adam in each Gaussian's own frame; adan: as GaussianImage; each has its own "
        "parameters and learning rates",
    )
    learning_rate_factor: float = Field(1.0, gt=0.0, description="factor on all learning rates of the optimizer")
    min_sigma: float = Field(
        0.5, ge=0.0, description="least standard deviation of a Gaussian in pixels, for the optimizer gaussian-adam"
    )
    bounded: bool = Field(
        False,
        description="keep centres within the image, factors below its longer side and colours in [-1, 2], for networks "
        "that learn these numbers; for the optimizer gaussian-adam, and for fits that are no video or file",
    )
    # The length
    iterations: int | None = Field(
        None, ge=1, description="None: 700, or with `max_seconds` as many as the time allows"
    )
    max_seconds: float | None = Field(
        None,
        gt=0.0,
        description="seconds that a fit may take, about; its schedule then follows the time, not the iterations",
    )
    target_psnr: float | None = Field(
        None, gt=0.0, description="about the fewest Gaussians that reach this PSNR (dB), by a search over several fits"
    )

    def __init__(self, **values: Any) -> None:
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise _first(error) from None

    @field_validator("objective", mode="before")
    @classmethod
    def _check_objective(cls, value: object) -> ObjectiveName | None:
        return check_objective(value)

    def model_post_init(self, context: Any) -> None:
        """Check the ranges that the types do not express."""
        if self.backend not in BACKENDS:
            raise InvalidArgument("backend", f"one of {', '.join(BACKENDS)}", repr(self.backend))
        if self.softness != "auto" and not 0.0 <= self.softness <= MAX_SOFTNESS:
            raise InvalidArgument("softness", f"'auto' or in [0, {MAX_SOFTNESS:g}] pixels", repr(self.softness))
        if self.bounded and self.optimizer != "gaussian-adam":
            raise InvalidArgument("bounded", f"False with the optimizer {self.optimizer}", True)
        if self.max_move != "any" and self.max_move < 1.0:
            raise InvalidArgument("max_move", "'any' or at least 1 pixel", repr(self.max_move))

    @property
    def planned_iterations(self) -> int:
        """Iterations of a fit without a time limit."""
        return self.iterations or _USUAL_ITERATIONS

    @property
    def iteration_limit(self) -> float:
        """Largest number of iterations; infinite where only the clock ends the fit."""
        return math.inf if self.iterations is None and self.max_seconds is not None else self.planned_iterations

    if not TYPE_CHECKING:  # for a type checker, any name would exist

        def __getattr__(self, name: str) -> Any:
            if name in _names_0_3.PROPERTIES:
                raise AttributeError(f"{name} of a FitConfig is {_names_0_3.PROPERTIES[name]} now")
            return super().__getattr__(name)

    def __repr__(self) -> str:
        changed = [(name, value) for name, value in self if value != type(self).model_fields[name].default]
        return shorten(f"FitConfig({', '.join(f'{name}={value!r}' for name, value in changed)})")

    @classmethod
    def from_recipe(cls, recipe: str | FitConfig, **settings: Any) -> FitConfig:
        """Take a recipe and change some of its settings.

        Args:
            recipe: a name from :func:`available_recipes`, or settings.
            settings: by name.

        Raises:
            TypeError: a recipe of another type.
            ValueError: unknown recipe or setting, or a value out of range.
        """
        if isinstance(recipe, FitConfig):
            values = recipe.model_dump()
        elif not isinstance(recipe, str):
            raise InvalidArgumentType("recipe", "a name or a FitConfig", type(recipe).__name__)
        elif recipe not in available_recipes():
            raise InvalidArgument("recipe", f"one of {', '.join(available_recipes())}", _names_0_3.describe(recipe))
        else:
            values = tomllib.loads((files("kcgs.recipes") / f"{recipe}.toml").read_text(encoding="utf-8"))
        return cls(**{**values, **settings})


def config_for(purpose: Purpose, config: FitConfig) -> FitConfig:
    """Return the settings with the objective of a purpose; refuse settings that the purpose does not take."""
    if config.bounded and purpose != "fit":
        raise InvalidArgument("bounded", f"False for a {purpose}", True)
    return config.model_copy(update={"objective": objective_for(purpose, config.objective)})


def available_recipes() -> list[str]:
    """Names of the recipes that come with the package, sorted.

    Example:
        >>> "paper" in available_recipes()
        True
    """
    return sorted(f.name.removesuffix(".toml") for f in files("kcgs.recipes").iterdir() if f.name.endswith(".toml"))


def _first(error: ValidationError) -> Exception:
    """Return the first of pydantic's errors as one of ours."""
    detail = error.errors()[0]
    name = ".".join(map(str, detail["loc"][:1]))  # without the branches of a union
    if detail["type"] == "extra_forbidden":
        if name in _names_0_3.SETTINGS:
            return ValueError(f"unknown setting {name!r}: {_names_0_3.SETTINGS[name]}")
        near = get_close_matches(name, FitConfig.model_fields, 1)
        hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(FitConfig.model_fields)}"
        return ValueError(f"unknown setting {name!r}: {hint}")
    if detail["type"] == "value_error":
        return cast(Exception, detail["ctx"]["error"])
    expected = detail["msg"].removeprefix("Input should be ")
    return InvalidArgument(name, expected, _names_0_3.describe(detail["input"]))
