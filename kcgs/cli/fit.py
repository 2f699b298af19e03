"""The command fit, and functions that it shares with fit-many."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from kcgs._atomic import write_file
from kcgs._objectives import Purpose
from kcgs._progress import Progress
from kcgs._suffixes import SCENES
from kcgs.errors import InvalidArgument

from . import options
from .commands import app
from .common import ImageFile, InterruptHandler, Json, Quiet, check_new, check_output, exit_interrupted, print_report

if TYPE_CHECKING:
    from torch import Tensor

    from kcgs.fitting import FitConfig, FitResult
    from kcgs.scene import Scene

# dB by which a fit must exceed a target, since rounding to a file loses them
_ROUNDING_MARGIN = 0.15


@app.command("fit")
@options.with_fit_options
def fit_command(
    image: ImageFile,
    *,
    regions: Annotated[
        str,
        typer.Option(
            metavar="MASK|auto|none", help=f"Label-map file, or auto (segment the image, {options.IF_LARGE}), or none."
        ),
    ] = "auto",
    request: options.FitRequest,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Scene (.safetensors) or file (.kcgs); default: IMAGE's name, here."),
    ] = None,
    overwrite: options.Overwrite = False,
    threshold: options.Threshold = None,
    resize_regions: options.ResizeRegions = False,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Fit Gaussians to an image and save the scene. Ctrl-C saves the best so far.

    EF-PSNR and EF-SSIM are along the contours of the label map as it was before the fit; those of `eval` are along the
    scene's, which the fit may have moved. The seconds are those of the fit and of the writing of its file.
    """
    output = output or Path(f"{image.stem}{request.default_suffix}")
    check_output(output, *(SCENES if request.target_bytes is None else (".kcgs",)))
    check_new(output, overwrite)
    file_config(output, request)  # refuses wrong settings before the work
    request.load_device()  # and a device that torch lacks
    target = request.load_image(image)
    labels = read_regions(regions, target, threshold, resize=resize_regions, progress=not quiet)
    with InterruptHandler() as interrupts:
        saved_fit = fit_and_save(output, target, labels, request, on_step=interrupts.on_step, progress=not quiet)
    report, regions_report = report_fit(saved_fit, target, labels, output, request), saved_fit.result.regions
    assert not isinstance(regions_report, list)  # the image is no batch
    if interrupts.count:
        report["stop_reason"] = "interrupted"
    if as_json:
        report["region_report"] = None if regions_report is None else asdict(regions_report)
    print_report(report, as_json, str(output))
    if regions_report is not None and not as_json:
        is_lost = regions_report.num_before > 1 == regions_report.num_after and regions_report.dropped != "recipe"
        typer.echo(f"regions: {regions_report}{'. --keep-contours keeps them' if is_lost else ''}")
    if labels is None and regions == "auto" and not as_json:
        typer.echo(f"regions: none, for a side is below {options.LEAST_SIDE} pixels")
    if interrupts.count:
        raise exit_interrupted(f"the best so far to {output}")
    if report["target_reached"] is False:
        target_psnr, psnr = request.load_config().target_psnr, report["psnr"]
        typer.echo(f"kcgs: --target-psnr {target_psnr:g} was not reached: {psnr:.2f} dB is the best", err=True)
        raise typer.Exit(1)


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
    request: options.FitRequest,
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


def file_config(output: Path, request: options.FitRequest) -> FitConfig:
    """Return the settings of a fit for a file; refuse those that the file does not take.

    A compressed file needs a higher target, since rounding lowers the PSNR.
    """
    from kcgs.fitting import config_for

    purpose: Purpose = "file of a PSNR" if request.target_bytes is None else "file of a size"
    config = config_for(purpose if output.suffix == ".kcgs" else "fit", request.load_config())
    if output.suffix != ".kcgs" or request.target_bytes is not None or config.target_psnr is None:
        return config
    return config.model_copy(update={"target_psnr": config.target_psnr + _ROUNDING_MARGIN})


def save_result(
    output: Path, image: Tensor, result: FitResult, request: options.FitRequest, *, progress: bool = False
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


def read_regions(
    regions: str, image: Tensor, threshold: float | None = None, *, resize: bool = False, progress: bool = False
) -> Tensor | None:
    """Return the label map of the option --regions, or None; `resize`: at the size of the image."""
    if regions in ("auto", "none"):
        options.exclude(f"--regions {regions}", threshold=threshold)
    if regions == "none":
        return None
    if regions == "auto":
        if min(image.shape[-2:]) < options.LEAST_SIDE:
            return None
        from kcgs.segment import segment

        with Progress("finding regions", pulse=True, visible=progress):
            return segment(image)
    from kcgs.data import load_labels

    labels, size = load_labels(Path(regions), threshold=threshold), (image.shape[-2], image.shape[-1])
    if tuple(labels.shape) == size:
        return labels
    if not resize:
        expected = f"one map of the image's size, {size[1]} x {size[0]}, which --resize-regions makes of it"
        raise InvalidArgument("regions", expected, f"{labels.shape[-1]} x {labels.shape[-2]}")
    from kcgs.maps import RegionMap

    return RegionMap(labels).resize(size).labels


def report_fit(
    saved_fit: SavedFit, image: Tensor, labels: Tensor | None, output: Path, request: options.FitRequest
) -> dict[str, Any]:
    """Return the metrics of the file (EF metrics along the contours of `labels`), and how the fit ended."""
    from kcgs.evaluation import evaluate

    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # the table says it
        metrics = evaluate(saved_fit.scene, image, labels, with_ssimulacra2=False)
    target_psnr = request.load_config().target_psnr
    return {
        **metrics,
        **describe_scene(saved_fit.scene),
        "seconds": saved_fit.seconds,
        **describe_file(output, saved_fit.num_bytes, saved_fit.scene.size),
        "stop_reason": saved_fit.result.stop_reason,
        "target_reached": None if target_psnr is None else metrics["psnr"] >= target_psnr,
    }


def describe_scene(scene: Scene) -> dict[str, int]:
    """Return the numbers of Gaussians and of regions."""
    regions = 1 if scene.regions is None else scene.regions.num_regions
    return {"num_gaussians": scene.num_gaussians, "regions": regions}


def describe_file(path: Path, num_bytes: int, size: tuple[int, int]) -> dict[str, float | None]:
    """Return the size of a file in bytes, and the bits per pixel of a compressed file."""
    rate = 8 * num_bytes / (size[0] * size[1]) if path.suffix == ".kcgs" else None
    return {"bytes": num_bytes, "bits_per_pixel": rate}
