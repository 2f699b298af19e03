"""What the commands that read a scene do with a clip."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from kcgs._progress import Progress

from .common import OUTPUT_IMAGES, VIDEOS, check_output, print_report
from .options import exclude, frame_rate, target_size

if TYPE_CHECKING:
    from torch import Tensor

    from kcgs.clip import Clip
    from kcgs.scene import Scene

# encoders of those whose files have others than most
_CODECS = {".webm": "libvpx-vp9"}
# key frames that a table has room for
_SHOWN = 6


def is_clip(path: Path) -> bool:
    """Say whether a file holds frames."""
    from kcgs.codec.clips import file

    if path.suffix != ".kcgs" or not path.is_file():
        return False
    with path.open("rb") as opened:
        return file.is_clip(opened.read(16))


def read_clip(path: Path, num_bytes: int | None = None) -> Clip:
    """Read a clip, or the whole frames that its first bytes hold."""
    from kcgs.clip import Clip
    from kcgs.codec import CodecError

    if num_bytes is None:
        return Clip.load(path)
    try:
        return Clip.from_bytes(path.read_bytes()[:num_bytes], whole=False)
    except CodecError as error:
        raise CodecError(f"cannot decode {path}: {error}") from error


def render_clip(
    clip: Clip,
    output: Path,
    *,
    scale: float | None,
    size: str | None,
    contours: str,
    rate: str | None = None,
    frame: float | None = None,
    progress: bool = False,
) -> None:
    """Write a clip as a video, as a folder of PNGs, or one time of it as an image."""
    from kcgs.data import save_image, write_video

    target = target_size(clip[0], scale, size)
    if frame is not None:
        exclude("--frame", frame_rate=rate)
        check_output(output, *OUTPUT_IMAGES)
        from kcgs._check import check_number

        check_number("frame", frame, 0.0, len(clip) - 1.0, unit="frames")
        save_image(output, clip.render(frame, target, contours))
        return
    if output.suffix.lower() in OUTPUT_IMAGES:
        raise typer.BadParameter(f"--output must be a video or a folder, or come with --frame; got {str(output)!r}")
    if output.suffix:
        check_output(output, *VIDEOS)
    if (channels := clip[0].field.colors.shape[-1]) not in (1, 3):
        raise ValueError(f"a video must have 1 or 3 channels; got a clip of {channels}: --frame writes one time of it")
    wanted = _wanted_rate(rate, clip.frame_rate)
    times = _times(clip, wanted)
    codec = _CODECS.get(output.suffix.lower(), "libx264")
    with Progress("rendering", shown=progress) as bar:

        def frames() -> Iterator[Tensor]:
            for number, time in enumerate(times, 1):
                image = clip.render(time, target, contours)
                yield image.expand(3, -1, -1) if len(image) == 1 else image
                bar.update(number / len(times), f"frame {number} of {len(times)}")

        write_video(output, frames(), wanted, codec=codec)


def _wanted_rate(text: str | None, rate: Fraction) -> Fraction:
    """Return the frames per second that the option --frame-rate asks for: a number, or a multiple of the clip's."""
    if text is None:
        return rate
    times = text.lower().endswith("x")
    try:
        number = frame_rate(text[:-1] if times else text)
    except typer.BadParameter as error:
        raise typer.BadParameter(f"{error.message}; 2x is twice the clip's", param_hint="'--frame-rate'") from error
    return rate * number if times else number


def _times(clip: Clip, rate: Fraction) -> Sequence[float]:
    """Return the times, in frames, of a video of the clip."""
    step = clip.frame_rate / rate
    return [float(number * step) for number in range(1 + math.floor((len(clip) - 1) / step))]


def describe_clip(clip: Clip) -> dict[str, Any]:
    """Say what a clip holds."""
    with Progress("reading the clip") as bar:
        counts = []
        for number, scene in enumerate(clip, 1):
            counts.append(_count(scene))
            bar.update(number / len(clip))
    return _describe(clip, counts)


def _count(scene: Scene) -> tuple[int, int]:
    """Return how many Gaussians and regions a frame has."""
    return len(scene), 1 if scene.regions is None else scene.regions.num_regions


def _describe(clip: Clip, counts: list[tuple[int, int]]) -> dict[str, Any]:
    seconds, pixels = len(clip) / clip.frame_rate, math.prod(clip.size)
    return {
        "height": clip.size[0],
        "width": clip.size[1],
        "frames": len(clip),
        "frame_rate": float(clip.frame_rate),
        "clip_seconds": float(seconds),
        "key_frames": list(clip.key_frames),
        "num_gaussians": counts[0][0],
        "most_gaussians": max(count for count, _ in counts),
        "regions": max(count for _, count in counts),
        "bytes": clip.num_bytes,
        "kbps": float(8 * clip.num_bytes / seconds / 1000),
        "bits_per_pixel": 8 * clip.num_bytes / (pixels * len(clip)),
    }


def show_clip(report: dict[str, Any], as_json: bool, title: str, contours: str = "") -> None:
    """Print a table, which has the first key frames, or one JSON object."""
    if not as_json:
        keys = report["key_frames"]
        more = f" and {len(keys) - _SHOWN} more" if len(keys) > _SHOWN else ""
        report = report | {"key_frames": f"{len(keys)} ({', '.join(map(str, keys[:_SHOWN]))}{more})"}
    print_report(report, as_json, title, contours)


def measure_clip(
    clip: Clip, video: Iterable[Any], maps: Iterable[Any] | None = None, *, progress: bool = False
) -> dict[str, Any]:
    """Return means of the frames' metrics, where they are defined, and what the clip holds.

    Edge-focused metrics are along given maps, or the clip's. Of a video and maps that go on, the rest is not looked at.
    """
    from kcgs.evaluation import measure

    found: list[dict[str, float]] = []
    counts = []
    images, given = iter(video), None if maps is None else iter(maps)
    with Progress("comparing", shown=progress) as bar:
        for number, scene in enumerate(clip):
            if (image := next(images, None)) is None:
                raise ValueError(f"IMAGE must have the {len(clip)} frames of the clip; got {number}")
            labels = None if scene.regions is None else scene.regions.labels
            if given is not None and (labels := next(given, None)) is None:
                raise ValueError(f"--regions must have a map for each of {len(clip)} frames; got {number}")
            found.append(measure(scene.render(), image, labels))
            counts.append(_count(scene))
            bar.update((number + 1) / len(clip), f"frame {number + 1} of {len(clip)}")
    means = {name: _mean([figures[name] for figures in found]) for name in found[0]}
    return means | _describe(clip, counts)


def _mean(values: list[float]) -> float:
    defined = [value for value in values if not math.isnan(value)]
    return sum(defined) / len(defined) if defined else math.nan
