"""The command that fits a video, and what `kcgs render` does with a batch of scenes."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from . import options
from .common import IMAGES, OUTPUT_IMAGES, Json, Quiet, Stop, app, check_output, interrupted, print_report
from .fit import compile_ahead, read_regions

if TYPE_CHECKING:
    from torch import Tensor

    from kcgs.scene import Scene

# videos that H.264 is written into
_OUTPUT_VIDEOS = (".mp4", ".mov", ".mkv")
# options of a fit that mean one image
_OF_ONE_IMAGE = ("max_seconds", "target_psnr", "target_bytes")


@app.command("fit-video")
@partial(options.with_fit_options, without=_OF_ONE_IMAGE)
def fit_video_command(
    video: Annotated[Path, typer.Argument(help="Video file, or folder of images.", metavar="VIDEO")],
    *,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Batch of scenes to write (.safetensors); default: VIDEO's name, here."),
    ] = None,
    regions: Annotated[
        str,
        typer.Option(
            metavar="MASKS|auto|none",
            help="Folder of label maps, one for each frame; or the file of the first frame's, or auto (segment the "
            "first frame), which are carried on; or none.",
        ),
    ] = "auto",
    request: options.FitRequest,
    frame_rate: Annotated[
        float | None, typer.Option(help="Frames per second; default: the file's, of a folder 24.")
    ] = None,
    frames: Annotated[int | None, typer.Option(min=1, help="Fit so many frames only.")] = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Fit Gaussians to a video, each frame from the one before, and save a batch of scenes."""
    output = Path(f"{video.stem}.safetensors") if output is None else output
    check_output(output, ".safetensors")
    if video.suffix.lower() in IMAGES and video.is_file():
        raise typer.BadParameter(f"VIDEO must be a video or a folder of images; got {str(video)!r}: kcgs fit fits it")
    compile_ahead(request.config, False)
    from kcgs.data import load_labels
    from kcgs.functional import psnr
    from kcgs.video import fit_video, read_label_maps, read_video

    source = read_video(video, frame_rate=frame_rate)
    maps: list[Tensor] | Tensor | None
    if Path(regions).is_dir():
        maps = read_label_maps(regions)
    elif regions in ("auto", "none"):
        maps = read_regions(regions, next(iter(source)), progress=not quiet)
    else:
        maps = load_labels(regions, rgb_ids=True)
    start = time.perf_counter()
    with Stop() as stop:
        scenes = fit_video(
            source, maps, options.DEFAULT_GAUSSIANS if request.num_gaussians is None else request.num_gaussians,
            recipe=request.config, seed=request.seed, progress=not quiet,
            on_frame=lambda number, scene: stop.step(number, scene) or number + 1 == frames,
        )  # fmt: skip
        seconds = time.perf_counter() - start
        size = scenes.save(output)
    errors = [float(psnr(scene.render(), frame)) for scene, frame in zip(scenes, source, strict=False)]
    report = {
        "frames": len(scenes), "width": scenes.size[1], "height": scenes.size[0],
        "frame_rate": float(scenes.metadata["frame_rate"]), "num_gaussians": scenes.num_gaussians,
        "regions": 1 if scenes.regions is None else scenes.regions.num_regions,
        "psnr": sum(errors) / len(errors), "psnr_least": min(errors), "seconds": seconds, "bytes": size,
    }  # fmt: skip
    print_report(report, as_json, str(output))
    if stop.wanted:
        raise interrupted(f"saved the {len(scenes)} frames that are done to {output}")


def render_batch(
    scenes: Scene,
    output: Path,
    *,
    scale: float | None,
    size: str | None,
    contours: str,
    rate: str | None,
    frame: float | None,
) -> None:
    """Write a batch as a video, as a folder of PNGs, or one time of it as an image."""
    from kcgs._check import check_number
    from kcgs.data import save_image
    from kcgs.video import interpolate, write_video

    target = options.target_size(scenes[0], scale, size)
    if frame is not None:
        options.exclude("--frame", frame_rate=rate)
        check_output(output, *OUTPUT_IMAGES)
        check_number("frame", frame, 0.0, len(scenes) - 1.0, unit="frames")
        save_image(output, interpolate(scenes, frame).render(target, contours))
        return
    if output.suffix.lower() in OUTPUT_IMAGES:
        raise typer.BadParameter(f"--output must be a video or a folder, or come with --frame; got {str(output)!r}")
    if output.suffix:
        check_output(output, *_OUTPUT_VIDEOS)
    own = float(scenes.metadata.get("frame_rate", 24))
    wanted = _frame_rate(rate, own)
    count = 1 + math.floor((len(scenes) - 1) * wanted / own + 1e-6)
    times = (min(number * own / wanted, len(scenes) - 1.0) for number in range(count))

    def frames() -> Iterator[Tensor]:
        for moment in times:
            yield interpolate(scenes, moment).render(target, contours)

    write_video(output, frames(), wanted)


def _frame_rate(text: str | None, own: float) -> float:
    """Return the frames per second that the option --frame-rate says: a number, or a multiple of the batch's own."""
    if text is None:
        return own
    try:
        rate = own * float(text[:-1]) if text.endswith("x") else float(text)
    except ValueError:
        rate = 0.0
    if not 0.0 < rate <= 1000.0:
        raise typer.BadParameter(f"--frame-rate must be frames per second, or 2x for twice the own; got {text!r}")
    return rate
