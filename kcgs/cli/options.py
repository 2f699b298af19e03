"""Options that several commands have, and the settings of a fit that they stand for."""

from __future__ import annotations

from enum import Enum
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from kcgs.fit import FitConfig

DEFAULT_GAUSSIANS = 1000


class Backend(str, Enum):
    """Kernels that can be named."""

    auto = "auto"
    reference = "reference"
    tiled = "tiled"
    cpu = "cpu"
    cuda = "cuda"


class Engine(str, Enum):
    """Where independent jobs run."""

    local = "local"
    ray = "ray"


Gaussians = Annotated[
    int | None,
    typer.Option("-n", "--num-gaussians", min=1, help=f"Number of Gaussians; default: {DEFAULT_GAUSSIANS}."),
]
Recipe = Annotated[str, typer.Option(help="Recipe by name.")]
Iterations = Annotated[int | None, typer.Option(min=1, help="Default: the recipe's.")]
MaxSeconds = Annotated[float | None, typer.Option(help="The best picture in this wall time.")]
TargetPsnr = Annotated[
    float | None, typer.Option(help="As few Gaussians as reach this PSNR in dB, at most --num-gaussians.")
]
TargetBytes = Annotated[
    int | None, typer.Option(min=1, help="The best .kcgs file that is not larger; chooses the number of Gaussians.")
]
KeepContours = Annotated[bool, typer.Option("--keep-contours", help="Take the label map as exact.")]
Seed = Annotated[int, typer.Option(help="Seed of the random start.")]
KernelName = Annotated[Backend, typer.Option(help="Kernel.")]
EngineName = Annotated[
    Engine, typer.Option(help="local: processes of this machine; ray: the cluster at RAY_ADDRESS, or one started here.")
]


def check_budget(target_bytes: int | None, **excluded: object) -> None:
    """Refuse what a size in bytes leaves no room for: options by their names, None where they were not given."""
    for name, given in excluded.items():
        if target_bytes is not None and given is not None:
            option = "--" + name.replace("_", "-")
            raise typer.BadParameter(f"--target-bytes chooses the Gaussians itself and excludes {option}")


def make_config(
    recipe: str,
    regions: str,
    *,
    iterations: int | None,
    max_seconds: float | None,
    target_psnr: float | None,
    keep_contours: bool,
    backend: Backend,
) -> FitConfig:
    """Return the settings that the options ask for."""
    from kcgs.fit import FitConfig

    settings = {"iterations": iterations, "max_seconds": max_seconds, "target_psnr": target_psnr}
    given: dict[str, Any] = {key: value for key, value in settings.items() if value is not None}
    if keep_contours:
        return FitConfig.from_recipe(recipe, backend=backend.value, move_contours=False, merge_regions=False, **given)
    if regions == "auto":
        # nobody gave these contours, so none are to be kept near
        free = FitConfig.from_recipe("best-refined")
        given |= {"max_move": free.max_move, "contour_rise": free.contour_rise}
    return FitConfig.from_recipe(recipe, backend=backend.value, **given)
