"""Commands that fit, draw and measure: arguments in, calls to the library, one line out."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .common import IMAGES, Json, Progress, SceneFile, app, check_output, print_report
from .fitting import fit_into, measure_scene, read_regions
from .options import (
    DEFAULT_GAUSSIANS,
    Backend,
    Engine,
    EngineName,
    Gaussians,
    Iterations,
    KeepContours,
    KernelName,
    MaxSeconds,
    Recipe,
    Seed,
    TargetBytes,
    TargetPsnr,
    check_budget,
    make_config,
)

if TYPE_CHECKING:
    from kcgs.functional import RegionMap


ImageFile = Annotated[Path, typer.Argument(help="Image file: PNG, JPEG, WebP, TIFF.", metavar="IMAGE")]


@app.command("fit")
def fit_command(
    image: ImageFile,
    regions: Annotated[
        str,
        typer.Option(metavar="MASK|auto|none", help="Label-map file, or auto (segment the image), or none."),
    ] = "auto",
    num_gaussians: Gaussians = None,
    recipe: Recipe = "best",
    iterations: Iterations = None,
    max_seconds: MaxSeconds = None,
    target_psnr: TargetPsnr = None,
    target_bytes: TargetBytes = None,
    keep_contours: KeepContours = False,
    seed: Seed = 0,
    backend: KernelName = Backend.auto,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Scene (.safetensors) or file (.kcgs); default: IMAGE's name, here."),
    ] = None,
    plot: Annotated[Path | None, typer.Option(help="Draw error against run time into this PNG.")] = None,
    checkpoint: Annotated[Path | None, typer.Option(help="Keep the fit's state in this file as it goes.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from --checkpoint, where it exists.")] = False,
    as_json: Json = False,
) -> None:
    """Fit Gaussians to an image and save the scene."""
    from kcgs.data import load_image

    suffixes = (".safetensors", ".kcgs") if target_bytes is None else (".kcgs",)
    output = Path(f"{image.stem}{suffixes[0]}") if output is None else output
    check_output(output, *suffixes)
    check_budget(target_bytes, num_gaussians=num_gaussians, target_psnr=target_psnr, checkpoint=checkpoint)
    if plot is not None:
        check_output(plot, ".png", option="--plot")
    if resume and checkpoint is None:
        raise typer.BadParameter("--resume needs --checkpoint")
    config = make_config(
        recipe, regions, iterations=iterations, max_seconds=max_seconds, target_psnr=target_psnr,
        keep_contours=keep_contours, backend=backend,
    )  # fmt: skip
    picture = load_image(image)
    labels = read_regions(regions, picture, partial(typer.echo, err=True))
    count = DEFAULT_GAUSSIANS if num_gaussians is None else num_gaussians
    with Progress(config.iterations, config.max_seconds) as progress:
        fitted = fit_into(
            output, picture, labels, count, target_bytes,
            recipe=recipe, seed=seed, config=config, on_step=progress.step, checkpoint=checkpoint, resume=resume,
        )  # fmt: skip
    result = fitted.result
    if plot is not None:
        from kcgs.plots import plot_history

        plot_history(plot, {recipe: result.history})
    if progress.interrupted:
        typer.echo(f"interrupted: saved the best so far to {output}", err=True)
    seconds = result.history[-1].seconds
    report = measure_scene(fitted.field, fitted.regions, picture, labels, seconds, fitted.written)
    title = f"{output}: {len(fitted.field)} Gaussians, stopped by {result.stop_reason}"
    if result.removed:
        title += f"; {result.removed} useless ones removed, which changed no value by more than {result.change:.1g}"
    print_report(report, as_json, title)


@app.command()
def render(
    scene: SceneFile,
    output: Annotated[Path, typer.Option("-o", "--output", help="Image file to write.")],
    scale: Annotated[float | None, typer.Option(help="Magnification.")] = None,
    size: Annotated[str | None, typer.Option(metavar="WxH", help="Width and height in pixels.")] = None,
    region: Annotated[int | None, typer.Option(help="Draw only this region; the rest is black.")] = None,
) -> None:
    """Draw a scene at any size."""
    from kcgs.data import save_image
    from kcgs.io import load
    from kcgs.nn.renderer import render_image

    check_output(output, *IMAGES)
    loaded = load(scene)
    field = loaded.field
    target = target_size(field.size, scale, size)
    if region is not None:
        known = [] if loaded.regions is None else loaded.regions.ids.tolist()
        if field.region_ids is None or region not in known:
            raise ValueError(f"--region must be one of the scene's regions {known}; got {region}")
        field = field.subset(field.region_ids == region)
    save_image(output, render_image(field, loaded.regions, target))


@app.command("eval")
def eval_command(
    scene: SceneFile,
    image: ImageFile,
    regions: Annotated[
        str | None,
        typer.Option(metavar="MASK", help="Label map whose contours EF-PSNR looks at; default: the scene's."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Compare a scene with an image."""
    from kcgs.data import load_image, load_labels
    from kcgs.io import load

    loaded = load(scene)
    picture = load_image(image)
    if picture.shape[1:] != loaded.field.size:
        raise ValueError(f"IMAGE must have the size {loaded.field.size} of SCENE; got {tuple(picture.shape[1:])}")
    labels = loaded.regions.labels if loaded.regions is not None else None
    if regions is not None:
        labels = load_labels(Path(regions))
    report = measure_scene(loaded.field, loaded.regions, picture, labels, None, scene.stat().st_size)
    print_report(report, as_json, str(scene))


@app.command()
def info(scene: SceneFile, as_json: Json = False) -> None:
    """Say what a scene file holds."""
    from kcgs.io import load

    loaded = load(scene)
    field, regions = loaded.field, loaded.regions
    size = scene.stat().st_size
    report = {
        "num_gaussians": len(field),
        "channels": field.colors.shape[-1],
        "height": field.size[0],
        "width": field.size[1],
        "regions": 1 if regions is None else regions.num_regions,
        "softness": 0.0 if regions is None else _mean_softness(regions),
        "bytes": size,
        "bits_per_pixel": 8 * size / (field.size[0] * field.size[1]),
        **{f"metadata.{key}": value for key, value in loaded.metadata.items()},
    }
    print_report(report, as_json, str(scene))


@app.command()
def bench(
    name: Annotated[str, typer.Argument(help="Experiment by name; a wrong one is answered with all of them.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the report.")],
    data: Annotated[Path | None, typer.Option(help="Folder with images, where the experiment needs them.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="A short form of the same.")] = False,
    only: Annotated[str | None, typer.Option(help="Parts to run, with commas between, where it has parts.")] = None,
    engine: EngineName = Engine.local,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Fits at a time; seconds that are compared want one, the default.")
    ] = None,
    sequences: Annotated[str | None, typer.Option(help="Of DAVIS, with commas between; default: all.")] = None,
    budget_seconds: Annotated[
        float | None, typer.Option(help="As many fits as this time allows; the same call again goes on.")
    ] = None,
    seeds: Annotated[int | None, typer.Option(min=1, help="Fits with so many seeds each.")] = None,
    iterations: Annotated[int | None, typer.Option(min=1, help="Of the published recipes.")] = None,
    runs: Annotated[Path | None, typer.Option(help="Folder of the fits, which experiments may share.")] = None,
) -> None:
    """Run an experiment and write its report. The last five options are for ablation, charts, convergence, davis."""
    from kcgs.bench import run

    run(
        name, output, data=data, quick=quick, only=only, engine=engine.value, workers=workers,
        sequences=sequences, budget_seconds=budget_seconds, seeds=seeds, iterations=iterations, runs=runs,
    )  # fmt: skip


def _mean_softness(regions: RegionMap) -> float:
    softness = regions.softness
    return softness if isinstance(softness, float) else sum(softness.values()) / max(1, len(softness))


def target_size(size: tuple[int, int], scale: float | None, wanted: str | None) -> tuple[int, int]:
    """Return the (height, width) that the options --scale and --size ask for."""
    if scale is not None and wanted is not None:
        raise typer.BadParameter("give --scale or --size, not both")
    if wanted is not None:
        width, _, height = wanted.lower().partition("x")
        if not (width.isdigit() and height.isdigit() and int(width) and int(height)):
            raise typer.BadParameter(f"--size must be WxH, such as 640x480; got {wanted!r}")
        return int(height), int(width)
    if scale is not None and not 0 < scale < math.inf:
        raise typer.BadParameter(f"--scale must be positive; got {scale!r}")
    factor = 1.0 if scale is None else scale
    return max(1, round(size[0] * factor)), max(1, round(size[1] * factor))
