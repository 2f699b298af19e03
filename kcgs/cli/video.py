"""The command fit-video, and the part of `kcgs render` that renders a batch of scenes."""

from __future__ import annotations

import math
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from kcgs._atomic import check_writable
from kcgs._suffixes import VIDEOS, WRITTEN_IMAGES

from . import options
from .commands import app
from .common import InterruptHandler, Json, Quiet, check_new, check_output, exit_interrupted
from .reports import describe_scene, print_report

if TYPE_CHECKING:
    from kcgs.scene import Scene

# options of a fit that make sense only for one image
_SINGLE_IMAGE_OPTIONS = ("max_seconds", "target_psnr", "target_bytes", "device", "bounded", "grey")


@app.command("fit-video")
@partial(options.with_fit_options, without=_SINGLE_IMAGE_OPTIONS)
def fit_video_command(
    video: Annotated[Path, typer.Argument(help="Video file, or folder of images.", metavar="VIDEO")],
    *,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            help="Batch of scenes to write (.safetensors), or a folder for one scene per frame; default: VIDEO's name, "
            "here.",
        ),
    ] = None,
    regions: Annotated[
        str,
        typer.Option(
            metavar="MASKS|auto|none",
            help="Folder of label maps, one for each frame; or a label map of the first frame, or auto (segment the "
            f"first frame, {options.IF_LARGE}), which follow the motion; or none.",
        ),
    ] = "auto",
    threshold: options.Threshold = None,
    request: options.FitRequest,
    frame_rate: Annotated[
        float | None, typer.Option(help="Frames per second; default: the file's, of a folder 24.")
    ] = None,
    overwrite: options.Overwrite = False,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Fit Gaussians to a video, each frame from the one before, and save a batch of scenes."""
    output = output or Path(f"{video.stem}.safetensors")
    if output.suffix:  # none: a folder
        check_output(output, ".safetensors")
    else:  # it is made after the fit, in the first folder above it that exists
        folder = next(path for path in (output, *output.absolute().parents) if path.exists())
        check_writable("--output", folder / "00000.safetensors")
    check_new(output, overwrite)
    from kcgs.data import load_labels
    from kcgs.fitting import config_for
    from kcgs.functional import psnr
    from kcgs.video import fit_video, read_label_maps, read_video

    config = config_for("video", request.load_config())  # refuses wrong settings before the work
    source = read_video(video, frame_rate=frame_rate)
    maps: Any
    if Path(regions).is_dir():
        options.exclude("a folder of label maps", threshold=threshold)
        maps = read_label_maps(regions)
    elif regions in ("auto", "none"):
        maps = options.read_regions(regions, next(iter(source)), threshold, progress=not quiet)
    else:
        maps = load_labels(regions, rgb_ids=True, threshold=threshold)
    start = time.perf_counter()
    with InterruptHandler() as interrupts:
        scenes = fit_video(
            source, maps, request.num_gaussians, recipe=config, seed=request.seed, progress=not quiet,
            on_frame=interrupts.on_step,
        )  # fmt: skip
        seconds = time.perf_counter() - start
        size = _save(scenes, output)
    psnrs = [float(psnr(scene.render(), frame)) for scene, frame in zip(scenes, source, strict=False)]
    report = {
        "frames": len(scenes), "width": scenes.size[1], "height": scenes.size[0],
        "frame_rate": float(scenes.metadata["frame_rate"]), **describe_scene(scenes),
        "psnr": sum(psnrs) / len(psnrs), "psnr_least": min(psnrs), "seconds": seconds, "bytes": size,
    }  # fmt: skip
    print_report(report, as_json, str(output))
    if interrupts.count:
        raise exit_interrupted(f"the {len(scenes)} frames that are done to {output}")


def _save(scenes: Scene, output: Path) -> int:
    """Write a batch to a file, or its scenes to a folder as 00000.safetensors and so on; return the size in bytes."""
    if output.suffix:
        return scenes.save(output)
    output.mkdir(parents=True, exist_ok=True)
    return sum(scene.save(output / f"{number:05}.safetensors") for number, scene in enumerate(scenes))


def render_batch(
    scenes: Scene, output: Path, size: tuple[int, int], frame_rate: float | None, frame: float | None
) -> int:
    """Write a batch as a video or a folder of PNGs, or a single time as an image; return the number of images."""
    from kcgs._check import check_number
    from kcgs.data import save_image
    from kcgs.video import DEFAULT_FRAME_RATE, interpolate, write_video

    if frame is not None:
        options.exclude("--frame", frame_rate=frame_rate)
        check_output(output, *WRITTEN_IMAGES)
        check_number("frame", frame, 0.0, len(scenes) - 1.0, unit="frames")
        save_image(output, interpolate(scenes, frame).render(size))
        return 1
    if output.suffix:  # none: a folder
        check_output(output, *VIDEOS)
    scene_rate = float(scenes.metadata.get("frame_rate", DEFAULT_FRAME_RATE))
    rate = scene_rate if frame_rate is None else check_number("frame_rate", frame_rate, 0.0, 1000.0, above=True)
    count = 1 + math.floor((len(scenes) - 1) * rate / scene_rate + 1e-6)
    times = (min(number * scene_rate / rate, len(scenes) - 1.0) for number in range(count))
    write_video(output, (interpolate(scenes, time).render(size) for time in times), rate)
    return count
