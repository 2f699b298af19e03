"""Commands that fit, draw and measure: arguments in, calls to the library, one line out."""

from __future__ import annotations

import math
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .common import IMAGES, Json, Progress, SceneFile, app, check_output, print_report
from .fitting import fit_into
from .segmentation import warn_if_misaligned

if TYPE_CHECKING:
    from torch import Tensor

    from kcgs.functional import RegionMap


class Backend(str, Enum):
    """Kernels that can be named."""

    auto = "auto"
    reference = "reference"
    tiled = "tiled"
    cpu = "cpu"
    cuda = "cuda"


ImageFile = Annotated[Path, typer.Argument(help="Image file: PNG, JPEG, WebP, TIFF.", metavar="IMAGE")]


@app.command("fit")
def fit_command(
    image: ImageFile,
    regions: Annotated[
        str,
        typer.Option(metavar="MASK|auto|none", help="Label-map file, or auto (segment the image), or none."),
    ] = "auto",
    num_gaussians: Annotated[
        int | None, typer.Option("-n", "--num-gaussians", min=1, help="Number of Gaussians; default: 1000.")
    ] = None,
    recipe: Annotated[str, typer.Option(help="Recipe by name.")] = "best",
    iterations: Annotated[int | None, typer.Option(min=1, help="Default: the recipe's.")] = None,
    max_seconds: Annotated[float | None, typer.Option(help="The best picture in this wall time.")] = None,
    target_psnr: Annotated[
        float | None, typer.Option(help="As few Gaussians as reach this PSNR in dB, at most --num-gaussians.")
    ] = None,
    target_bytes: Annotated[
        int | None, typer.Option(min=1, help="The best .kcgs file that is not larger; chooses the number of Gaussians.")
    ] = None,
    keep_contours: Annotated[bool, typer.Option("--keep-contours", help="Take the label map as exact.")] = False,
    seed: Annotated[int, typer.Option(help="Seed of the random start.")] = 0,
    backend: Annotated[Backend, typer.Option(help="Kernel.")] = Backend.auto,
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
    from kcgs.fit import FitConfig

    suffixes = (".safetensors", ".kcgs") if target_bytes is None else (".kcgs",)
    output = Path(f"{image.stem}{suffixes[0]}") if output is None else output
    check_output(output, *suffixes)
    if target_bytes is not None:
        for name, given in (("-n", num_gaussians), ("--target-psnr", target_psnr), ("--checkpoint", checkpoint)):
            if given is not None:
                raise typer.BadParameter(f"--target-bytes chooses the Gaussians itself and excludes {name}")
    if plot is not None:
        check_output(plot, ".png", option="--plot")
    if resume and checkpoint is None:
        raise typer.BadParameter("--resume needs --checkpoint")
    settings: dict[str, Any] = {"iterations": iterations, "max_seconds": max_seconds, "target_psnr": target_psnr}
    if keep_contours:
        settings |= {"refine": False, "release": False}
    elif regions == "auto":
        # nobody gave these contours, so none are to be kept near
        free = FitConfig.from_recipe("best-refined")
        settings |= {"max_move": free.max_move, "contour_rise": free.contour_rise}
    config = FitConfig.from_recipe(
        recipe, backend=backend.value, **{k: v for k, v in settings.items() if v is not None}
    )
    picture = load_image(image)
    labels = _read_regions(regions, picture)
    count = 1000 if num_gaussians is None else num_gaussians
    with Progress(config.iterations, config.max_seconds) as progress:
        fitted = fit_into(
            output, picture, labels, count, target_bytes,
            recipe=recipe, seed=seed, config=config, on_step=progress.step, checkpoint=checkpoint, resume=resume,
        )  # fmt: skip
    result = fitted.result
    if plot is not None:
        from kcgs.bench.plots import plot_history

        plot_history(plot, {recipe: result.history})
    if progress.interrupted:
        typer.echo(f"interrupted: saved the best so far to {output}", err=True)
    seconds = result.history[-1].seconds
    report = _measure(fitted.field, fitted.regions, picture, labels, seconds, fitted.written)
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
    report = _measure(loaded.field, loaded.regions, picture, labels, None, scene.stat().st_size)
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
    name: Annotated[str, typer.Argument(help="Experiment by name: decode, demo, fit, maps, rate, render, zoo.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the report.")],
    data: Annotated[Path | None, typer.Option(help="Folder with images, where the experiment needs them.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="A short form of the same.")] = False,
    only: Annotated[str | None, typer.Option(help="Parts to run, with commas between, where it has parts.")] = None,
) -> None:
    """Run an experiment and write its report."""
    from kcgs.bench import run

    run(name, output, data=data, quick=quick, only=only)


def _read_regions(regions: str, picture: Tensor) -> Tensor | None:
    if regions == "none":
        return None
    if regions == "auto":
        from kcgs.segment import segment as make_labels

        return make_labels(picture)
    from kcgs.data import load_labels

    labels = load_labels(Path(regions))
    warn_if_misaligned(picture, labels, regions)
    return labels


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


def _measure(
    field: Any,
    regions: RegionMap | None,
    picture: Tensor,
    labels: Tensor | None,
    seconds: float | None,
    written: int,
) -> dict[str, Any]:
    import time

    from kcgs.bench.measure import measure
    from kcgs.nn.renderer import render_image

    start = time.perf_counter()
    drawn = render_image(field, regions)
    seconds = time.perf_counter() - start if seconds is None else seconds
    height, width = field.size
    return {
        **measure(drawn, picture, labels),
        "num_gaussians": len(field),
        "seconds": seconds,
        "bytes": written,
        "bits_per_pixel": 8 * written / (height * width),
    }
