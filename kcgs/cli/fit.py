"""The command that fits an image, and what it shares with the one that fits many."""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from kcgs._atomic import check_writable, write_file
from kcgs._progress import Progress

from . import options
from .common import VIDEOS, ImageFile, Json, Quiet, Stop, app, check_output, interrupted, print_report

if TYPE_CHECKING:
    from torch import Tensor

    from kcgs.fitting import FitConfig, FitResult
    from kcgs.kernels.compiled import Program
    from kcgs.scene import Scene

# contours that people traced reach 0.63 and more on their image, at most 0.54 on its mirror image
_ALIGNED = 0.58
# of the seconds that a fit and a compressed file of it may take
_FIT_SHARE = 0.75
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
    plot: Annotated[Path | None, typer.Option(help="Plot error against run time into this PNG.")] = None,
    checkpoint: Annotated[Path | None, typer.Option(help="Keep the fit's state in this file as it goes.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from --checkpoint, where it exists.")] = False,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Fit Gaussians to an image and save the scene."""
    if image.suffix.lower() in VIDEOS:
        raise typer.BadParameter(f"IMAGE must be an image; got {str(image)!r}: kcgs fit-video fits videos")
    suffixes = (".safetensors", ".kcgs") if request.target_bytes is None else (".kcgs",)
    output = Path(f"{image.stem}{suffixes[0]}") if output is None else output
    check_output(output, *suffixes)
    if plot is not None:
        check_output(plot, ".png", option="--plot")
    if resume and checkpoint is None:
        raise typer.BadParameter("--resume needs --checkpoint")
    if checkpoint is not None:
        check_writable("--checkpoint", checkpoint)
    if request.target_bytes is not None:
        options.exclude("--target-bytes", checkpoint=checkpoint)
    if request.config.target_psnr is not None:
        options.exclude("--target-psnr", checkpoint=checkpoint)
    compile_ahead(request.config, output.suffix == ".kcgs" and regions != "none")
    from kcgs.data import load_image

    target = load_image(image)
    labels = read_regions(regions, target, progress=not quiet)
    with Stop() as stop:
        fitted = fit_into(
            output, target, labels, request,
            on_step=stop.step, progress=not quiet, checkpoint=checkpoint, resume=resume,
        )  # fmt: skip
        result = fitted.result
        if plot is not None:
            from kcgs.plots import history_figure, save_figure

            save_figure(history_figure({request.recipe: result.history}), plot)
        report = report_fit(fitted, target, labels, output, request)
    reason = report["stop_reason"]
    ended = reason if reason == "interrupted" else f"stopped by {reason}"
    title = f"{output}: {fitted.scene.num_gaussians} Gaussians, {ended}"
    if result.removed:
        title += f"; {result.removed} useless ones removed, which changed no value by more than {result.change:.1g}"
    became = result.regions
    if as_json:
        report["region_report"] = None if became is None else asdict(became)
    contours = {"none": "", "auto": "the regions found in the image, as found"}.get(regions, f"{regions}, as given")
    print_report(report, as_json, title, contours)
    if became is not None and not as_json:
        typer.echo(f"regions: {became}")
    if stop.wanted:
        raise interrupted(f"saved the best so far to {output}")
    if missed := describe_miss(report, request):
        typer.echo(f"kcgs: {missed}", err=True)
        raise typer.Exit(1)


def compile_ahead(config: FitConfig, writes_map: bool) -> list[Program]:
    """Begin to compile, in other processes, what a fit and its file need: seconds, once on a machine."""
    from kcgs.kernels import compile_ahead

    programs = compile_ahead(config.backend)
    if writes_map:
        from kcgs.codec.labels.wavefront import program

        programs.append(program.start())
    return programs


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
    on_step: Any = None,
    progress: bool = False,
    checkpoint: Path | None = None,
    resume: bool = False,
    notes: Mapping[str, str] | None = None,
) -> Fitted:
    """Fit, and write the scene, with notes in it, or the compressed file, as the suffix says."""
    from kcgs.fitting import fit
    from kcgs.kernels import prepare
    from kcgs.rate import compress, fit_bytes, quality_for
    from kcgs.scene import Scene

    check_writable("--output", output)
    config, target, compressed = request.config, request.config.target_psnr, output.suffix == ".kcgs"
    prepare(config.backend, image.device, image.dtype, len(image))
    left = request.clock.left(image)
    if left is not None:
        share = _FIT_SHARE if compressed and request.target_bytes is None else 1.0
        config = config.model_copy(update={"max_seconds": share * left})
    if target is not None and compressed:  # rounding costs some
        config = config.model_copy(update={"target_psnr": target + _ROUNDING})
    settings: Any = {"recipe": config, "seed": request.seed, "on_step": on_step, "progress": progress}
    if request.target_bytes is not None:
        done = fit_bytes(image, labels, request.target_bytes, **settings)
        return Fitted(done.result, done.scene, write_file(output, done.data))
    count = request.num_gaussians or min(options.DEFAULT_GAUSSIANS, image.shape[1] * image.shape[2])
    result = fit(image, labels, count, checkpoint=checkpoint, resume=resume, **settings)
    if not compressed:
        scene = Scene(result.scene.field, result.scene.regions, {"recipe": request.recipe, **(notes or {})})
        return Fitted(result, scene, scene.save(output))
    quality = quality_for(max(entry.psnr for entry in result.history)) if target is None else None
    with Progress("writing the file", known=False, shown=progress):
        goal: Any = {"quality": quality, "target_psnr": target, "max_seconds": request.clock.left(image)}
        file = compress(result.scene, image, seed=request.seed, objective=config.objective, **goal)
    return Fitted(result, file.scene, write_file(output, file.data))


def read_regions(regions: str, image: Tensor, *, progress: bool = False) -> Tensor | None:
    """Return the label map that the option --regions names; warn where its contours are not the image's."""
    if regions == "none":
        return None
    if regions == "auto":
        from kcgs.segment import segment

        with Progress("finding regions", known=False, shown=progress):
            return segment(image)
    from kcgs.data import load_labels
    from kcgs.functional import edge_alignment

    if not Path(regions).is_file():
        raise FileNotFoundError(f"--regions must be auto, none or the file of a label map; no such file: {regions}")
    labels = load_labels(Path(regions))
    # the fit refuses one of another size
    alignment = float(edge_alignment(image, labels)) if labels.shape == image.shape[1:] else 1.0
    if alignment < _ALIGNED:
        warnings.warn(
            f"the contours of {regions} hardly follow the image's edges: alignment {alignment:.2f}, where chance gives "
            "0.50 and good masks 0.63 or more; does the mask belong to this image?",
            stacklevel=2,
        )
    return labels


def measure_scene(
    scene: Scene, image: Tensor, labels: Tensor | None, path: Path, num_bytes: int, seconds: float | None = None
) -> dict[str, Any]:
    """Compare a scene, as its file at `path` has it, with its image: what `fit` and `eval` print.

    Edge-focused metrics look at the contours of `labels`; `seconds` are those of the fit. Without these the time of
    the rendering is taken, and SSIMULACRA2, which fits do not wait for.
    """
    from kcgs.evaluation import measure, ssimulacra2
    from kcgs.kernels import prepare

    colors = scene.field.colors
    prepare("auto", colors.device, colors.dtype, colors.shape[-1])
    start = time.perf_counter()
    render = scene.render()
    took, figures = time.perf_counter() - start, measure(render, image, labels)
    if seconds is None:
        figures["ssimulacra2"] = ssimulacra2(render, image)
    return {
        **figures,
        "num_gaussians": scene.num_gaussians,
        "regions": 1 if scene.regions is None else scene.regions.num_regions,
        "seconds": took if seconds is None else seconds,
        **describe_size(path, num_bytes, scene.size),
    }


def describe_size(path: Path, num_bytes: int, size: tuple[int, int]) -> dict[str, float | None]:
    """Return the size of a file and, of a compressed one, that by the pixels of its image."""
    rate = 8 * num_bytes / (size[0] * size[1]) if path.suffix == ".kcgs" else None
    return {"bytes": num_bytes, "bits_per_pixel": rate}


def report_fit(
    fitted: Fitted, image: Tensor, labels: Tensor | None, output: Path, request: options.FitRequest
) -> dict[str, Any]:
    """Measure what was written of a fit, and say how the fit ended."""
    report = measure_scene(fitted.scene, image, labels, output, fitted.num_bytes, fitted.result.seconds)
    # the only callback of a command is Ctrl-C's
    reason = "interrupted" if fitted.result.stop_reason == "callback" else fitted.result.stop_reason
    report |= {"total_seconds": time.perf_counter() - request.clock.began, "stop_reason": reason}
    goals = request.config.target_psnr, request.target_bytes, request.clock.seconds
    return report | {"target_reached": None if goals == (None, None, None) else not describe_miss(report, request)}


def describe_miss(report: Mapping[str, Any], request: options.FitRequest) -> str:
    """Return the line that says which targets were missed, if any; a size in bytes is kept, or refused by the fit."""
    target, seconds, missed = request.config.target_psnr, request.clock.seconds, []
    # the file counts, not what it was rounded from
    if target is not None and report["psnr"] < target:
        most = request.num_gaussians or options.DEFAULT_GAUSSIANS
        ends = {"seconds": "the time was over", "interrupted": "it was interrupted", "diverged": "the fit diverged"}
        why = ends.get(report["stop_reason"], f"{most} Gaussians do not reach it, -n allows more")
        missed.append(f"--target-psnr {target:g} was not reached: {report['psnr']:.2f} dB is the best; {why}")
    if seconds is not None and report["total_seconds"] > seconds:
        took = f"with the image's regions, metrics and file it took {report['total_seconds']:.1f} s"
        missed.append(f"--max-seconds {seconds:g} was not kept: {took}")
    return "; ".join(missed)
