"""Fit an image, and write its scene or compressed file."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from kcgs._atomic import write_file
from kcgs._progress import Progress

from .options import FitRequest

if TYPE_CHECKING:
    from torch import Tensor

    from kcgs.fitting import FitConfig, FitResult
    from kcgs.scene import Scene

# dB by which a fit must exceed a target, since rounding to a file loses them
_ROUNDING_MARGIN = 0.15


class SavedFit(NamedTuple):
    """A fit and its file."""

    result: FitResult
    scene: Scene
    """The scene that the file holds: rounded, if the file is compressed."""
    num_bytes: int
    seconds: float
    """Wall time of the fit and of writing the file."""


def fit_and_save(
    output: Path,
    image: Tensor,
    labels: Tensor | None,
    request: FitRequest,
    *,
    on_step: Callable[..., bool] | None = None,
    progress: bool = False,
) -> SavedFit:
    """Fit an image, and write the scene or the compressed file, by the suffix of `output`."""
    from kcgs.fitting import fit
    from kcgs.rate import fit_bytes

    device, start = request.load_device(), time.perf_counter()
    on_device = image.to(device), None if labels is None else labels.to(device)
    settings: Any = {"recipe": file_config(output, request), "seed": request.seed}
    settings |= {"on_step": on_step, "progress": progress}
    if request.target_bytes is not None:
        file = fit_bytes(*on_device, request.target_bytes, **settings)
        result, scene, num_bytes = file.result, file.scene, write_file(output, file.data)
    else:
        result = fit(*on_device, request.num_gaussians, **settings)
        scene, num_bytes = save_result(output, image, result, request, progress=progress)
    return SavedFit(result, scene, num_bytes, time.perf_counter() - start)


def file_config(output: Path, request: FitRequest) -> FitConfig:
    """Return the settings of a fit for a file; refuse those that the file does not take.

    A compressed file needs a higher target, since rounding lowers the PSNR.
    """
    from kcgs.fitting import config_for

    config = request.load_config()
    if output.suffix != ".kcgs":
        return config_for("fit", config)
    if request.target_bytes is not None:
        return config_for("file of a size", config)
    config = config_for("file of a PSNR", config)
    if config.target_psnr is None:
        return config
    return config.model_copy(update={"target_psnr": config.target_psnr + _ROUNDING_MARGIN})


def save_result(
    output: Path, image: Tensor, result: FitResult, request: FitRequest, *, progress: bool = False
) -> tuple[Scene, int]:
    """Write the scene of a fit of one image, by the suffix of `output`; return the file's scene and size in bytes."""
    from kcgs import Scene, load

    scene, config = Scene(result.scene.field, result.scene.regions, {"recipe": request.recipe}), request.load_config()
    is_rounded = output.suffix == ".kcgs"
    rounding: dict[str, Any] = {
        "image": image, "seed": request.seed, "target_psnr": config.target_psnr, "objective": config.objective,
        "min_sigma": request.settings.get("min_sigma"),
    }  # fmt: skip
    with Progress("writing the file", pulse=True, visible=progress and is_rounded):
        num_bytes = scene.save(output, **(rounding if is_rounded else {}))
    return load(output), num_bytes
