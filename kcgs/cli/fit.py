"""The command that fits an image, and what it shares with the one that fits many."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from kcgs._atomic import write_file
from kcgs._progress import Progress

from . import options
from .common import SCENES, ImageFile, Json, Quiet, Stop, app, check_output, exit_interrupted, print_report

if TYPE_CHECKING:
    from torch import Tensor

    from kcgs.fitting import FitResult
    from kcgs.scene import Scene

# dB that a fit must have to spare where it is then rounded to a file
_ROUNDING = 0.15


@app.command("fit")
@options.with_fit_options
def fit_command(
    image: ImageFile,
    *,
    regions: Annotated[
        str, typer.Option(metavar="MASK|auto|none", help="Label-map file, or auto (segment the image), or none.")
    ] = "auto",
    request: options.FitRequest,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Scene (.safetensors) or file (.kcgs); default: IMAGE's name, here."),
    ] = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Fit Gaussians to an image and save the scene. Ctrl-C saves the best so far."""
    suffixes = SCENES if request.target_bytes is None else (".kcgs",)
    output = output or Path(f"{image.stem}{suffixes[0]}")
    check_output(output, *suffixes)
    from kcgs.data import load_image

    target = load_image(image)
    labels = read_regions(regions, target, progress=not quiet)
    with Stop() as stop:
        fitted = fit_into(output, target, labels, request, on_step=stop.step, progress=not quiet)
    report, regions_report = report_fit(fitted, target, labels, output, request), fitted.result.regions
    if stop.wanted:
        report["stop_reason"] = "interrupted"
    if as_json:
        report["region_report"] = None if regions_report is None else asdict(regions_report)
    print_report(report, as_json, str(output))
    if regions_report is not None and not as_json:
        typer.echo(f"regions: {regions_report}")
    if stop.wanted:
        raise exit_interrupted(f"the best so far to {output}")
    if report["target_reached"] is False:
        target_psnr = request.config.target_psnr
        typer.echo(
            f"kcgs: --target-psnr {target_psnr:g} was not reached: {report['psnr']:.2f} dB is the best", err=True
        )
        raise typer.Exit(1)


class Fitted(NamedTuple):
    """A fit, and what was written of it."""

    result: FitResult
    scene: Scene
    """As it is in the file."""
    num_bytes: int


def fit_into(
    output: Path,
    image: Tensor,
    labels: Tensor | None,
    request: options.FitRequest,
    *,
    on_step: Callable[..., bool] | None = None,
    progress: bool = False,
) -> Fitted:
    """Fit, and write the scene or the compressed file, as the suffix says."""
    from kcgs.fitting import fit
    from kcgs.rate import compress, fit_bytes, quality_for
    from kcgs.scene import Scene

    config, target, is_compressed = request.config, request.config.target_psnr, output.suffix == ".kcgs"
    if target is not None and is_compressed:
        config = config.model_copy(update={"target_psnr": target + _ROUNDING})
    settings: Any = {"recipe": config, "seed": request.seed, "on_step": on_step, "progress": progress}
    if request.target_bytes is not None:
        done = fit_bytes(image, labels, request.target_bytes, **settings)
        return Fitted(done.result, done.scene, write_file(output, done.data))
    result = fit(image, labels, request.num_gaussians, **settings)
    if not is_compressed:
        scene = Scene(result.scene.field, result.scene.regions, {"recipe": request.recipe})
        return Fitted(result, scene, scene.save(output))
    quality = quality_for(max(entry.psnr for entry in result.history)) if target is None else None
    with Progress("writing the file", known=False, shown=progress):
        goal: Any = {"quality": quality, "target_psnr": target, "objective": config.objective}
        file = compress(result.scene, image, seed=request.seed, **goal)
    return Fitted(result, file.scene, write_file(output, file.data))


def read_regions(regions: str, image: Tensor, *, progress: bool = False) -> Tensor | None:
    """Return the label map that the option --regions names."""
    if regions == "none":
        return None
    if regions == "auto":
        from kcgs.segment import segment

        with Progress("finding regions", known=False, shown=progress):
            return segment(image)
    from kcgs.data import load_labels

    return load_labels(Path(regions))


def report_fit(
    fitted: Fitted, image: Tensor, labels: Tensor | None, output: Path, request: options.FitRequest
) -> dict[str, Any]:
    """Measure what was written of a fit, along the contours of `labels`, and say how the fit ended."""
    from kcgs.evaluation import evaluate

    figures = evaluate(fitted.scene, image, labels, visual=False)
    target = request.config.target_psnr
    return {
        **figures,
        **describe_scene(fitted.scene),
        "seconds": fitted.result.seconds,
        **describe_size(output, fitted.num_bytes, fitted.scene.size),
        "stop_reason": fitted.result.stop_reason,
        "target_reached": None if target is None else figures["psnr"] >= target,
    }


def describe_scene(scene: Scene) -> dict[str, int]:
    """Return the numbers of Gaussians and of regions."""
    regions = 1 if scene.regions is None else scene.regions.num_regions
    return {"num_gaussians": scene.num_gaussians, "regions": regions}


def describe_size(path: Path, num_bytes: int, size: tuple[int, int]) -> dict[str, float | None]:
    """Return the size of a file and, of a compressed one, that by the pixels of its image."""
    rate = 8 * num_bytes / (size[0] * size[1]) if path.suffix == ".kcgs" else None
    return {"bytes": num_bytes, "bits_per_pixel": rate}
