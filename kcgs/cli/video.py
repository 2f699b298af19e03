"""The command that fits a video."""

from __future__ import annotations

import time
from collections.abc import Iterator
from fractions import Fraction
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from kcgs._atomic import check_writable

from . import options
from .clips import measure_clip, show_clip
from .common import IMAGES, Json, Quiet, Stop, app, check_output, interrupted
from .fit import compile_ahead, read_regions

if TYPE_CHECKING:
    from kcgs.clip import Clip
    from kcgs.data import FrameReader
    from kcgs.rate.video.report import FrameReport

# a clip has frames of one kind, so that goals of a still are none of its own
_OF_STILLS = ("max_seconds", "target_psnr", "target_bytes")


@app.command("fit-video")
@partial(options.with_fit_options, without=_OF_STILLS)
def fit_video_command(
    video: Annotated[Path, typer.Argument(help="Video file, or folder of images.", metavar="VIDEO")],
    *,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Clip to write (.kcgs); default: VIDEO's name, here.")
    ] = None,
    regions: Annotated[
        str,
        typer.Option(
            metavar="MASKS|auto|none",
            help="Folder of label maps, one for each frame, or the file of the first frame's, which is carried on, or "
            "auto (segment the first frame), or none.",
        ),
    ] = "auto",
    request: options.FitRequest,
    frame_rate: Annotated[
        Fraction | None,
        typer.Option(
            metavar="RATE", parser=options.frame_rate, help="Frames per second; default: the file's, of a folder 24."
        ),
    ] = None,
    first: Annotated[int | None, typer.Option(min=1, help="Take so many frames only.")] = None,
    key_interval: Annotated[
        int, typer.Option(min=1, help="The most frames from one that needs no other to the next.")
    ] = 250,
    target_bytes: Annotated[
        int | None, typer.Option(min=1, help="The best clip that is not larger; chooses the number of Gaussians.")
    ] = None,
    kbps: Annotated[float | None, typer.Option(help="The same, in thousands of bits per second of the video.")] = None,
    checkpoint: Annotated[Path | None, typer.Option(help="Keep the frames that are done in this file.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from --checkpoint, where it exists.")] = False,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Fit Gaussians to a video, each frame from the one before, and save the clip."""
    from kcgs.data import read_video
    from kcgs.rate.video import fit_video

    output = Path(f"{video.stem}.kcgs") if output is None else output
    check_output(output, ".kcgs")
    if video.suffix.lower() in IMAGES and video.is_file():
        raise typer.BadParameter(f"VIDEO must be a video or a folder of images; got {str(video)!r}: kcgs fit fits it")
    if target_bytes is not None:
        options.exclude("--target-bytes", kbps=kbps)
    if resume and checkpoint is None:
        raise typer.BadParameter("--resume needs --checkpoint")
    if checkpoint is not None:
        check_writable("--checkpoint", checkpoint)
    compile_ahead(request.config, regions != "none")
    reader = read_video(video, frame_rate=frame_rate)
    has_budget = target_bytes is not None or kbps is not None
    frames = _Frames(reader, first, counted=has_budget)
    maps = _read_maps(regions, reader, frames, progress=not quiet)
    seconds: list[float] = []
    start = time.perf_counter()
    with Stop() as stop:

        def on_frame(report: FrameReport) -> bool:
            if not report.is_key:
                seconds.append(report.seconds)
            return stop.step(report.number, report)

        clip = fit_video(
            frames, maps, request.num_gaussians, target_bytes=target_bytes, kbps=kbps, key_interval=key_interval,
            frame_rate=reader.frame_rate, recipe=request.config, seed=request.seed, checkpoint=checkpoint,
            resume=resume, on_frame=on_frame, progress=not quiet,
        )  # fmt: skip
        took = time.perf_counter() - start
        clip.save(output)
        report = _report(clip, reader, maps, took, seconds, progress=not quiet)
    missed = _describe_miss(report, target_bytes, kbps)
    report["stop_reason"] = "interrupted" if stop.wanted else "end" if frames.error is None else "error"
    report["target_reached"] = not missed if has_budget else None
    show_clip(report, as_json, str(output), _whose(regions))
    done = f"{len(clip)} frames that are" if len(clip) > 1 else "frame that is"
    goes_on = "" if checkpoint is None else "; --resume goes on"
    saved = f"saved the {done} done to {output}{goes_on}"
    if stop.wanted:
        raise interrupted(saved)
    if frames.error is not None or missed:
        typer.echo(f"kcgs: {missed if frames.error is None else f'{frames.error}; {saved}'}", err=True)
        raise typer.Exit(1)


def _whose(regions: str) -> str:
    """Say along whose contours edge-focused metrics are."""
    whose = {"none": "", "auto": "the regions found in the first frame, as carried"}
    return whose.get(regions, f"{regions}, {'as given' if Path(regions).is_dir() else 'as carried'}")


def _describe_miss(report: dict[str, Any], target_bytes: int | None, kbps: float | None) -> str:
    """Return the line that says that the clip is larger than it should be, or nothing."""
    if target_bytes is not None and report["bytes"] > target_bytes:
        return f"--target-bytes {target_bytes} was not reached: {report['bytes']} is the least"
    if kbps is not None and report["kbps"] > kbps:
        return f"--kbps {kbps:g} was not reached: {report['kbps']:.4g} is the least"
    return ""


class _Frames:
    """The frames of a video, or the first ones, as far as they can be read; what ends them early is kept."""

    def __init__(self, reader: FrameReader, first: int | None, *, counted: bool) -> None:
        self._reader, self._first = reader, first
        self.error: Exception | None = None
        count = reader.num_frames
        if count is None and counted:
            count, self.error = sum(1 for _ in self), None
        self.count = count if count is None or first is None else min(first, count)

    def __length_hint__(self) -> int:
        return self.count or 0

    def __iter__(self) -> Iterator[Any]:
        number = 0
        try:
            for frame in islice(self._reader, self._first):
                yield frame
                number += 1
        except (OSError, ValueError) as error:
            if not number:
                raise
            self.error = error


def _read_maps(regions: str, reader: FrameReader, frames: _Frames, *, progress: bool) -> Any:
    """Return the label maps that the option --regions names: one for each frame, or the first frame's, or None."""
    from kcgs.data import read_label_maps

    if regions == "none":
        return None
    if regions != "auto" and not Path(regions).exists():
        raise FileNotFoundError(
            f"--regions must be auto, none, a label map or a folder of them; no such file: {regions}"
        )
    if regions == "auto" or not Path(regions).is_dir():
        return read_regions(regions, next(iter(reader)), progress=progress)
    maps = read_label_maps(regions)
    if maps.size != reader.size:
        raise ValueError(f"--regions must have maps of the size {reader.size} of VIDEO; got {maps.size} in {regions}")
    if len(maps) < (frames.count or 0):
        raise ValueError(f"--regions must have a map for each of {frames.count} frames; got {len(maps)} in {regions}")
    return maps


def _report(
    clip: Clip, reader: FrameReader, maps: Any, took: float, seconds: list[float], *, progress: bool
) -> dict[str, Any]:
    """Measure a clip that was fitted; where no map of each frame was given, along the contours that were carried on."""
    given = None if maps is None or hasattr(maps, "ndim") else maps
    metrics = measure_clip(clip, reader, given, progress=progress)
    per_frame = sum(seconds) / len(seconds) if seconds else None
    times = {"seconds": took, "core_seconds_per_carried_frame": per_frame}
    return metrics | times
