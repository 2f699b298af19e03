"""Commands that read a scene: render, eval, info, encode, decode."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import typer

from kcgs._atomic import write_file
from kcgs._progress import Progress

from .common import OUTPUT_IMAGES, ImageFile, Json, Quiet, SceneFile, app, check_output, print_report
from .fit import describe_size, measure_scene
from .options import Contours, Scale, Size, exclude, target_size

OutputImage = Annotated[Path, typer.Option("-o", "--output", help="Image file to write.")]


@app.command()
def render(
    scene: SceneFile,
    output: OutputImage,
    scale: Scale = None,
    size: Size = None,
    contours: Contours = "scaled",
    region: Annotated[int | None, typer.Option(help="Render only this region; the rest is black.")] = None,
) -> None:
    """Render a scene at any size."""
    from kcgs import load
    from kcgs.data import save_image
    from kcgs.editing import extract_region
    from kcgs.scene import check_unbatched

    check_output(output, *OUTPUT_IMAGES)
    loaded = check_unbatched(load(scene))
    target = target_size(loaded, scale, size)
    if region is not None:
        if loaded.regions is None or loaded.field.region_ids is None:
            raise ValueError(f"--region must not be given: {scene} has no regions")
        loaded = extract_region(loaded, region)
    save_image(output, loaded.render(target, contours))


@app.command("eval")
def eval_command(
    scene: SceneFile,
    image: ImageFile,
    regions: Annotated[
        Path | None,
        typer.Option(
            metavar="MASK", help="Label map whose contours EF-PSNR looks at; default: the scene's.", dir_okay=False
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Compare a scene with an image."""
    from kcgs import load
    from kcgs.data import load_image, load_labels
    from kcgs.scene import check_unbatched

    loaded, target = check_unbatched(load(scene)), load_image(image)
    if target.shape[1:] != loaded.size:
        raise ValueError(f"IMAGE must have the size {loaded.size} of SCENE; got {tuple(target.shape[1:])}")
    labels = loaded.regions.labels if loaded.regions is not None else None
    if regions is not None:
        labels = load_labels(regions)
    contours = "" if labels is None else str(regions or "the scene")
    if find_spec("ssimulacra2") is None:
        typer.echo('kcgs: ssimulacra2 is not measured without its package: pip install "kcgs[visual]"', err=True)
    report = measure_scene(loaded, target, labels, scene, scene.stat().st_size)
    print_report(report, as_json, str(scene), contours)


@app.command()
def info(scene: SceneFile, as_json: Json = False) -> None:
    """Say what a scene file holds."""
    from kcgs import load

    loaded = load(scene)
    softness = 0.0 if loaded.regions is None else loaded.regions.softness
    if not isinstance(softness, float):
        softness = sum(softness.values()) / max(1, len(softness))
    report = {
        "images": loaded.field.means.shape[:-2].numel(),
        "num_gaussians": len(loaded),
        "channels": loaded.field.colors.shape[-1],
        "height": loaded.size[0],
        "width": loaded.size[1],
        "regions": 1 if loaded.regions is None else loaded.regions.num_regions,
        "softness": softness,
        **describe_size(scene, scene.stat().st_size, loaded.size),
        **{f"metadata.{key}": value for key, value in loaded.metadata.items()},
    }
    print_report(report, as_json, str(scene))


@app.command()
def encode(
    scene: SceneFile,
    output: Annotated[Path, typer.Option("-o", "--output", help="File to write (.kcgs).")],
    target_bytes: Annotated[int | None, typer.Option(min=1, help="The finest file that is not larger.")] = None,
    quality: Annotated[
        float | None,
        typer.Option(help="PSNR in dB of the file's render against the scene's; 46 where neither is given."),
    ] = None,
    image: Annotated[
        Path | None,
        typer.Option(
            help="The image that the scene shows: Gaussians then make up for each other's rounding.", dir_okay=False
        ),
    ] = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Compress a scene."""
    from kcgs import codec, load
    from kcgs.functional import psnr

    check_output(output, ".kcgs")
    if target_bytes is not None:
        exclude("--target-bytes", quality=quality)
    loaded = load(scene)
    goal: dict[str, Any] = {"quality": quality, "target_bytes": target_bytes}
    with Progress("writing the file", known=False, shown=not quiet):
        if image is None:
            data = codec.encode(loaded, **goal)
        else:
            from kcgs.data import load_image
            from kcgs.rate import compress

            data = compress(loaded, load_image(image), **goal).data
    write_file(output, data)
    decoded = codec.decode(data)
    rounded = decoded.scene
    report = {
        "psnr_to_scene": float(psnr(rounded.render(), loaded.render())),
        "num_gaussians": len(rounded),
        "regions": 1 if rounded.regions is None else rounded.regions.num_regions,
        "layers": decoded.num_layers,
        **describe_size(output, len(data), loaded.size),
        "bits_per_gaussian": 8 * len(data) / len(rounded),
    }
    print_report(report, as_json, str(output))


@app.command()
def decode(
    file: Annotated[Path, typer.Argument(help="Compressed file (.kcgs).", metavar="FILE", dir_okay=False)],
    output: OutputImage,
    num_bytes: Annotated[int | None, typer.Option("--bytes", min=1, help="Read only the first bytes.")] = None,
    scale: Scale = None,
    size: Size = None,
    contours: Contours = "scaled",
) -> None:
    """Render a compressed file, or the coarser image that its first bytes hold."""
    from kcgs import codec
    from kcgs.data import save_image

    check_output(output, *OUTPUT_IMAGES)
    try:
        decoded = codec.decode(file.read_bytes(), max_bytes=num_bytes)
    except codec.CodecError as error:
        raise codec.CodecError(f"cannot decode {file}: {error}") from error
    scene = decoded.scene
    if decoded.layers < decoded.num_layers:
        part = f"{decoded.layers} of {decoded.num_layers} layers, {len(scene)} Gaussians"
        typer.echo(f"{file}: a coarser image, {part}", err=True)
    save_image(output, scene.render(target_size(scene, scale, size), contours))
