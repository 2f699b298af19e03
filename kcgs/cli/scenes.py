"""Commands that read a scene: render, eval, info, encode, decode; the last three take label maps, too."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import typer

from kcgs._atomic import write_file
from kcgs._progress import Progress
from kcgs.errors import InvalidArgument

from .common import (
    OUTPUT_IMAGES,
    SCENES,
    VIDEOS,
    ImageFile,
    Json,
    Quiet,
    SceneFile,
    SceneOrMap,
    app,
    check_output,
    print_report,
)
from .fit import describe_size, measure_scene
from .options import Contours, Objective, Scale, Size, exclude, target_size

OutputImage = Annotated[
    Path,
    typer.Option(
        "-o",
        "--output",
        help="Image file to write; of a batch of scenes a video (.mp4 and others), or a folder: no suffix.",
    ),
]


@app.command()
def render(
    scene: SceneFile,
    output: OutputImage,
    scale: Scale = None,
    size: Size = None,
    contours: Contours = "scaled",
    region_ids: Annotated[
        int | None, typer.Option("--region", metavar="ID", help="Render only this region; the rest is black.")
    ] = None,
    rate: Annotated[
        str | None,
        typer.Option(
            "--frame-rate", metavar="RATE|2x", help="Of a batch: frames per second, or a multiple of its own."
        ),
    ] = None,
    frame: Annotated[
        float | None, typer.Option(help="Of a batch: this time alone, in frames from 0; 0.5 is halfway to the next.")
    ] = None,
) -> None:
    """Render a scene at any size, or a batch of scenes as a video, at any frame rate."""
    if output.suffix:  # none: a folder
        check_output(output, *OUTPUT_IMAGES, *VIDEOS)
    from kcgs import load
    from kcgs.data import save_image
    from kcgs.editing import extract_region

    loaded = load(scene)
    if loaded.field.means.ndim == 3:
        from .video import render_batch

        exclude("a batch of scenes", region=region_ids)
        render_batch(loaded, output, scale=scale, size=size, contours=contours, rate=rate, frame=frame)
        return
    exclude("a scene of one image", frame_rate=rate, frame=frame)
    check_output(output, *OUTPUT_IMAGES)
    target = target_size(loaded, scale, size)
    if region_ids is not None:
        if loaded.regions is None or loaded.field.region_ids is None:
            raise InvalidArgument("region_ids", "given", f"{region_ids}: {scene} has no regions", verb="not be")
        loaded = extract_region(loaded, region_ids)
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
        expected = f"the size {loaded.size} of SCENE"
        raise InvalidArgument("image", expected, tuple(target.shape[1:]), verb="have")
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
    """Say what a file holds: a scene, a batch of scenes, or a label map."""
    from kcgs import load

    if (found := _read_map(scene)) is not None:
        print_report(_describe_map(scene, *found), as_json, str(scene))
        return
    loaded = load(scene)
    softness = 0.0 if loaded.regions is None else loaded.regions.softness
    if not isinstance(softness, float):
        softness = sum(softness.values()) / max(1, len(softness))
    report = {
        "images": loaded.field.means.shape[:-2].numel(),
        "num_gaussians": loaded.num_gaussians,
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
    scene: SceneOrMap,
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
    objective: Objective = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Compress a scene, or a label map without loss."""
    from kcgs import codec, load
    from kcgs.data import load_labels
    from kcgs.functional import psnr

    check_output(output, ".kcgs")
    if scene.suffix not in SCENES:
        exclude("a label map", target_bytes=target_bytes, quality=quality, image=image, objective=objective)
        labels = load_labels(scene, rgb_ids=True)
        ids = labels.unique()
        if len(ids) > max(256, labels.numel() / 64):
            typer.echo(f"kcgs: {scene} has {len(ids)} ids, as photos have, which kcgs fit takes", err=True)
        write_file(output, codec.encode_labels(labels))
        print_report(_describe_map(output, labels, ids), as_json, str(output))
        return
    if target_bytes is not None:
        exclude("--target-bytes", quality=quality)
    if image is None:
        exclude("a scene without --image", objective=objective)
    loaded = load(scene)
    goal: dict[str, Any] = {"quality": quality, "target_bytes": target_bytes}
    with Progress("writing the file", known=False, shown=not quiet):
        if image is None:
            data = codec.encode(loaded, **goal)
        else:
            from kcgs.data import load_image
            from kcgs.rate import compress

            data = compress(loaded, load_image(image), **goal, objective=objective or "psnr").data
    write_file(output, data)
    decoded = codec.decode(data)
    rounded = decoded.scene
    report = {
        "psnr_to_scene": float(psnr(rounded.render(), loaded.render())),
        "num_gaussians": rounded.num_gaussians,
        "regions": 1 if rounded.regions is None else rounded.regions.num_regions,
        "layers": decoded.num_layers,
        **describe_size(output, len(data), loaded.size),
        "bits_per_gaussian": 8 * len(data) / rounded.num_gaussians,
    }
    print_report(report, as_json, str(output))


@app.command()
def decode(
    file: Annotated[Path, typer.Argument(help="Compressed file (.kcgs).", metavar="FILE", dir_okay=False)],
    output: Annotated[Path, typer.Option("-o", "--output", help="Image file; of a label map .png or .npy.")],
    num_bytes: Annotated[int | None, typer.Option("--bytes", min=1, help="Read only the first bytes.")] = None,
    scale: Scale = None,
    size: Size = None,
    contours: Contours = "scaled",
) -> None:
    """Render a compressed file, or the coarser image that its first bytes hold; or write its label map.

    A PNG has ids as palette indices, above 255 as 16-bit grey, above 65,535 as colours R + 256 G + 65536 B.
    """
    from kcgs import codec
    from kcgs.data import save_image, save_labels

    if (found := _read_map(file)) is not None:
        labels, ids = found
        exclude("a label map", bytes=num_bytes, scale=scale, size=size)
        check_output(output, ".png", ".npy")
        save_labels(output, labels, rgb_ids=output.suffix.lower() != ".npy" and int(ids.max()) > 65535)
        return
    check_output(output, *OUTPUT_IMAGES)
    try:
        decoded = codec.decode(file.read_bytes(), max_bytes=num_bytes)
    except codec.CodecError as error:
        raise codec.CodecError(f"cannot decode {file}: {error}") from error
    scene = decoded.scene
    if decoded.layers < decoded.num_layers:
        part = f"{decoded.layers} of {decoded.num_layers} layers, {scene.num_gaussians} Gaussians"
        typer.echo(f"{file}: a coarser image, {part}", err=True)
    save_image(output, scene.render(target_size(scene, scale, size), contours))


def _read_map(file: Path) -> Any:
    """Return the label map of a file that is one, with its ids, and None of any other."""
    from kcgs import codec
    from kcgs.codec.maps import decode_with_ids

    if not file.is_file() or not (data := file.read_bytes()).startswith(codec.MAP_MAGIC):
        return None
    try:
        return decode_with_ids(data)
    except codec.CodecError as error:
        raise codec.CodecError(f"cannot decode {file}: {error}") from error


def _describe_map(file: Path, labels: Any, ids: Any) -> dict[str, Any]:
    report = {"holds": "label map", "height": labels.shape[0], "width": labels.shape[1], "regions": len(ids)}
    report |= {"largest_id": int(ids.max()), "dtype": str(labels.dtype).removeprefix("torch.")}
    return report | describe_size(file, file.stat().st_size, tuple(labels.shape))
