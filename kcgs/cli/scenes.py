"""The commands render, eval, info, encode and decode, which read scenes; the last three also take label maps."""

from __future__ import annotations

import time
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from kcgs._atomic import write_file
from kcgs._progress import Progress
from kcgs._suffixes import SCENES, VIDEOS, WRITTEN_IMAGES

from .commands import app
from .common import ImageFile, Json, Quiet, SceneFile, SceneOrMap, check_output
from .options import Objective, ResizeRegions, Threshold, exclude, read_regions, target_size
from .reports import describe_file, describe_scene, print_report

if TYPE_CHECKING:
    from torch import Tensor

    from kcgs.scene import Scene


@app.command()
def render(
    scene: SceneFile,
    output: Annotated[
        Path,
        typer.Option(
            "-o", "--output", help="Image to write; of a batch of scenes a video (.mp4 and others), or a folder."
        ),
    ],
    scale: Annotated[float | None, typer.Option(help="Magnification.")] = None,
    size: Annotated[str | None, typer.Option(metavar="WxH", help="Width and height in pixels.")] = None,
    frame_rate: Annotated[float | None, typer.Option(help="Of a batch: frames per second; default: its own.")] = None,
    frame: Annotated[
        float | None, typer.Option(help="Of a batch: this time alone, in frames from 0; 0.5 is halfway to the next.")
    ] = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Render a scene at any size, or a batch of scenes as a video, at any frame rate."""
    if output.suffix:  # none: a folder
        check_output(output, *WRITTEN_IMAGES, *VIDEOS)
    from kcgs import load
    from kcgs.data import save_image

    loaded = load(scene)
    if loaded.num_images is not None:
        from .video import render_batch

        target = target_size(loaded[0], scale, size)
        with Progress("rendering frames", pulse=True, visible=not quiet):
            num_frames = render_batch(loaded, output, target, frame_rate, frame)
        print_report({"frames": num_frames, "height": target[0], "width": target[1]}, as_json, str(output))
        return
    exclude("a scene of one image", frame_rate=frame_rate, frame=frame)
    check_output(output, *WRITTEN_IMAGES)
    target = target_size(loaded, scale, size)
    save_image(output, loaded.render(target))
    print_report(_describe_image(output, target), as_json, str(output))


@app.command("eval")
def eval_command(
    scene: SceneFile,
    image: ImageFile,
    regions: Annotated[
        Path | None,
        typer.Option(
            metavar="MASK",
            help="Label map whose contours EF-PSNR looks at, such as that of the fit; default: the scene's.",
            dir_okay=False,
        ),
    ] = None,
    threshold: Threshold = None,
    resize_regions: ResizeRegions = False,
    as_json: Json = False,
) -> None:
    """Compare a scene with an image; the seconds are those of a render."""
    from kcgs import evaluate, load
    from kcgs.scene import check_unbatched

    loaded = check_unbatched(load(scene))
    target = _load_like(loaded, image)
    labels = read_regions("none" if regions is None else str(regions), target, threshold, resize=resize_regions)
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # the table says it
        report: dict[str, Any] = evaluate(loaded, target, labels)
    start = time.perf_counter()
    loaded.render()
    report |= {**describe_scene(loaded), "seconds": time.perf_counter() - start}
    print_report(report | describe_file(scene, scene.stat().st_size, loaded.size), as_json, str(scene))


@app.command()
def info(scene: SceneFile, as_json: Json = False) -> None:
    """Describe a scene with its regions, a batch of scenes, or a compressed label map.

    Regions have their id, area, mean colour, and x and y of a pixel inside. `view` shows the id of a region that is
    clicked.
    """
    from kcgs import load
    from kcgs._repr import shorten
    from kcgs.maps import mean_softness

    if (labels := _read_map(scene)) is not None:
        print_report(_describe_map(scene, labels), as_json, str(scene))
        return

    loaded = load(scene)
    report: dict[str, Any] = {
        "images": loaded.num_images or 1,
        **describe_scene(loaded),
        "channels": loaded.field.colors.shape[-1],
        "height": loaded.size[0],
        "width": loaded.size[1],
        "softness": 0.0 if loaded.regions is None else mean_softness(loaded.regions.softness),
        **describe_file(scene, scene.stat().st_size, loaded.size),
        **{f"metadata.{key}": value if as_json else shorten(value) for key, value in loaded.metadata.items()},
    }
    if loaded.regions is not None and loaded.num_images is None:
        table = _describe_regions(loaded)
        if as_json:
            report["table"] = table
        else:
            facts = "{area} pixels, one at {x}, {y}; mean {color}"
            report |= {f"region {row['id']}": facts.format_map(row) for row in table}
    print_report(report, as_json, str(scene))


@app.command()
def encode(
    scene: SceneOrMap,
    output: Annotated[Path, typer.Option("-o", "--output", help="File to write (.kcgs).")],
    target_bytes: Annotated[int | None, typer.Option(min=1, help="The finest file that is not larger.")] = None,
    quality: Annotated[
        float | None,
        typer.Option(
            help="PSNR in dB of the file's render against the scene's. Default: 46; with --image so much that the file "
            "is nearly as good as the scene."
        ),
    ] = None,
    image: Annotated[
        Path | None,
        typer.Option(
            help="The image that the scene shows: Gaussians then make up for each other's rounding.", dir_okay=False
        ),
    ] = None,
    objective: Objective = None,
    threshold: Threshold = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Compress a scene, or a label map without loss."""
    check_output(output, ".kcgs")
    if scene.suffix not in SCENES:
        exclude("a label map", target_bytes=target_bytes, quality=quality, image=image, objective=objective)
        from kcgs.codec import encode_labels
        from kcgs.data import load_labels

        labels = load_labels(scene, rgb_ids=True, threshold=threshold)
        write_file(output, encode_labels(labels))
        print_report(_describe_map(output, labels), as_json, str(output))
        return
    exclude("a scene", threshold=threshold)
    if image is None:
        exclude("a scene without --image", objective=objective)
    from kcgs import load
    from kcgs.functional import psnr

    loaded = load(scene)
    target = None if image is None else _load_like(loaded, image)
    with Progress("writing the file", pulse=True, visible=not quiet):
        num_bytes = loaded.save(output, image=target, quality=quality, target_bytes=target_bytes, objective=objective)
    rounded = load(output)
    report = {
        "psnr_to_scene": float(psnr(rounded.render(), loaded.render())),
        **describe_scene(rounded),
        **describe_file(output, num_bytes, loaded.size),
    }
    print_report(report, as_json, str(output))


@app.command()
def decode(
    file: Annotated[Path, typer.Argument(help="Compressed file (.kcgs).", metavar="FILE", dir_okay=False)],
    output: Annotated[Path, typer.Option("-o", "--output", help="Image file; of a label map .png or .npy.")],
    max_bytes: Annotated[int | None, typer.Option("--bytes", min=1, help="Read only the first bytes.")] = None,
    as_json: Json = False,
) -> None:
    """Render a compressed file, or the coarser image that its first bytes hold; or write its label map.

    A PNG has ids as palette indices, above 255 as 16-bit grey, above 65,535 as colours R + 256 G + 65536 B. For other
    sizes, `render` takes the same files.
    """
    from kcgs import codec
    from kcgs.data import save_image, save_labels

    if (labels := _read_map(file)) is not None:
        exclude("a label map", max_bytes=max_bytes)
        check_output(output, ".png", ".npy")
        save_labels(output, labels, rgb_ids=output.suffix.lower() == ".png" and int(labels.max()) > 65535)
        print_report(_describe_map(output, labels), as_json, str(output))
        return
    check_output(output, *WRITTEN_IMAGES)
    scene, layers, num_layers = codec.decode(file.read_bytes(), max_bytes=max_bytes)
    if max_bytes is None and layers < num_layers:
        typer.echo(f"warning: {file} ends after {layers} of {num_layers} layers: the image is coarser", err=True)
    save_image(output, scene.render(target_size(scene, None, None)))
    print_report(_describe_image(output, scene.size), as_json, str(output))


def _load_like(scene: Scene, image: Path) -> Tensor:
    """Read an image, with one channel if the scene has one."""
    from kcgs.data import load_image

    return load_image(image, channels="L" if scene.field.colors.shape[-1] == 1 else "RGB")


def _read_map(file: Path) -> Tensor | None:
    """Return the label map of a file if it is a compressed label map, else None."""
    from kcgs.codec import MAP_MAGIC, decode_labels

    data = file.read_bytes()
    return decode_labels(data) if data.startswith(MAP_MAGIC) else None


def _describe_regions(scene: Scene) -> list[dict[str, Any]]:
    """Return the id, the area, a pixel far inside and the mean colour of each region."""
    from kcgs.maps import interior_points

    assert scene.regions is not None
    image, labels = scene.render().detach().clamp(0, 1).cpu(), scene.regions.labels.cpu()
    ids, index = labels.unique(return_inverse=True)
    areas = index.flatten().bincount()
    levels = [
        (index.flatten().bincount(channel.flatten().double()) / areas).round().int().tolist() for channel in 255 * image
    ]
    xs, ys = interior_points(index)[0].T.tolist()
    colors = ["#" + "".join(f"{level:02x}" for level in color) for color in zip(*levels, strict=True)]
    rows = zip(ids.tolist(), areas.tolist(), xs, ys, colors, strict=True)
    return [dict(zip(("id", "area", "x", "y", "color"), row, strict=True)) for row in rows]


def _describe_image(file: Path, size: tuple[int, int]) -> dict[str, Any]:
    return {"height": size[0], "width": size[1], "bytes": file.stat().st_size}


def _describe_map(file: Path, labels: Tensor) -> dict[str, Any]:
    height, width = labels.shape
    report = {"holds": "label map", "height": height, "width": width}
    report |= {"regions": len(labels.unique()), "largest_id": int(labels.max())}
    return report | describe_file(file, file.stat().st_size, (height, width))
