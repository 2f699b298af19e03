"""What bench video measures, made once and kept: clips, files of single frames, streams of other codecs."""

from __future__ import annotations

import hashlib
import json
import math
import os
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from kcgs._atomic import write_file
from kcgs.clip import Clip
from kcgs.codec import decode
from kcgs.codec.clips.carried import Frame
from kcgs.codec.clips.file import KEY, unpack
from kcgs.codec.clips.frames import FrameReader
from kcgs.codec.clips.motion import expand, move_gaussians
from kcgs.fitting import FitConfig, fit, warm_up
from kcgs.functional import edge_band, ef_psnr, psnr
from kcgs.rate import compress, fit_bytes, quality_for
from kcgs.rate.video import carrying, fit_video
from kcgs.rate.video.encoder import VideoEncoder
from kcgs.rate.video.registration import register
from kcgs.rate.video.report import FrameReport

from . import _video_codecs
from ._rate_files import codec_digest
from .core import images
from .core.cases import BEST, QUICK_ITERATIONS
from .core.jobs import Place, make_all

# what is made
CLIP, SPARSE = "clip", "clip of every second frame"
QUALITY, BYTES = "files, equal quality", "files, equal bytes"
CODECS: dict[str, _video_codecs.VideoCodec] = {"x264": "x264", "x265": "x265", "AV1": "av1"}
# what is shown of the clip of every second frame, at the others
BETWEEN, MEAN, MEAN_PHOTO = "in between", "mean of two renders", "mean of two photos"
_STEPS = ("_BEFORE", "_CYCLE", "_FREE", "_ROUND")


# frames are carried on whatever that loses: bytes, quality and seconds are those of carried frames alone
_ALL_CARRIED: list[tuple[Any, str, Any]] = [(VideoEncoder, "_affords_key", lambda self: False)]


def _times(share: float) -> list[tuple[Any, str, Any]]:
    return [(carrying, name, round(share * getattr(carrying, name))) for name in _STEPS]


AS_IT_IS, NO_MAPS = "as it is", "no label maps"
LENGTHS = {"a quarter of the iterations": 0.25, "half the iterations": 0.5, "twice the iterations": 2.0}
# clips with parts of the encoder taken out or changed: whose, name, and what is there instead; no setting has these,
# since they are never better
VARIANTS: dict[str, list[tuple[Any, str, Any]]] = {
    AS_IT_IS: [],
    "no motion": [(VideoEncoder, "_motions", staticmethod(lambda part, *_: np.zeros_like(part.motions.last)))],
    "contours as predicted or given": [(carrying.Carrying, "_move_contours", lambda self, following: None)],
    "no new Gaussians": [(carrying, "_BORN_BITS", math.inf)],
    NO_MAPS: [],
    **{name: _times(share) for name, share in LENGTHS.items()},
}
QUICK_STRIDE, _PAN = 4, (2, 1)


class Run(NamedTuple):
    """What is made in one go."""

    sequence: str
    n: int
    method: str
    frames: tuple[int, ...]
    most: int = 0  # bytes that it may have; 0: as many as it takes

    def __str__(self) -> str:
        shown = f"frame {self.frames[0]}" if len(self.frames) == 1 else f"frames {self.frames[0]} to {self.frames[-1]}"
        return f"{self.sequence}, N = {self.n:,}, {self.method}, {shown}"


class Shot(NamedTuple):
    """A frame as one method shows it, and what that measures."""

    sequence: str
    n: int
    method: str
    frame: int
    bytes: float  # of streams: the mean
    psnr: float
    ef_psnr: float  # naN: the annotated map has no contour
    is_key: int = 0
    seconds: float = math.nan  # processor time
    fit_seconds: float = math.nan  # of these the fit's, of files
    born: int = 0
    changed: float = math.nan  # share of the Gaussians carried on that are not where motion takes them
    # mean squared error of the change since the frame before, in 8-bit levels: everywhere, away from and along contours
    flicker: float = math.nan
    flicker_inside: float = math.nan
    flicker_contours: float = math.nan
    flicker_followed: float = math.nan  # along the motion of the regions


class Made(NamedTuple):
    """What a run makes: files, and of each frame the image and what is known of it."""

    files: list[bytes]
    shown: list[Tensor]
    known: list[dict[str, Any]]


class Runs:
    """Makes runs and keeps them, their bytes beside what they measure, under a hash of all that they depend on."""

    def __init__(self, folder: Path, data: Path | None, quick: bool) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder, self.data, self.quick = folder.absolute(), None if data is None else data.absolute(), quick
        self.config = BEST.config(QUICK_ITERATIONS if quick else None)

    def obtain(self, runs: Sequence[Run], place: Place) -> list[str]:
        """Make what is missing; return what failed."""
        return make_all(self.make, [run for run in runs if not self._path(run).is_file()], place)

    def shots(self, run: Run) -> list[Shot] | None:
        """Return what is kept of a run; None: it is not there."""
        path = self._path(run)
        if not path.is_file():
            return None
        return [Shot(*shot) for shot in json.loads(path.read_text(encoding="utf-8"))["shots"]]

    def shown(self, run: Run) -> list[Tensor]:
        """Decode the frames of a run that is kept."""
        path, files = self._path(run), list[bytes]()
        data = path.with_suffix(".file").read_bytes()
        for size in json.loads(path.read_text(encoding="utf-8"))["sizes"]:
            files, data = [*files, data[:size]], data[size:]
        if run.method in CODECS:
            return _video_codecs.decode(files[0], CODECS[run.method]) if files else []
        if run.method in (QUALITY, BYTES):
            return [decode(file).scene.render() for file in files]
        return [scene.render() for scene in Clip.from_bytes(files[0])]

    def make(self, run: Run) -> None:
        """Make, measure, keep."""
        if not self.quick:
            _warm_up(self.config)
        samples = self.samples(run.sequence, run.frames)
        if run.method == SPARSE:
            (data, *_), shots = self._sparse(run, samples)
            files = [data]
        else:
            if run.method in CODECS:
                made = _stream(run, samples)
            else:
                made = self._files(run, samples) if run.method in (QUALITY, BYTES) else self._clip(run, samples)
            files, shots = made.files, list(_measured(run, samples, made))
        path = self._path(run)
        path.with_suffix(".file").write_bytes(b"".join(files))
        write_file(path, json.dumps({"shots": shots, "sizes": [len(file) for file in files]}))

    def samples(self, sequence: str, frames: tuple[int, ...]) -> list[images.Sample]:
        """Read frames with their maps."""
        return [_sample(sequence, frame, self.data, self.quick) for frame in frames]

    def _path(self, run: Run) -> Path:
        how: list[Any] = ["stream"]
        if run.method not in CODECS:
            # files of single frames are as they were when only clips have changed
            but = ("rate/video", "codec/clips") if run.method in (QUALITY, BYTES) else ()
            how = [codec_digest(but), self.config.model_dump(mode="json")]
        parts = json.dumps([*run, self.quick, str(self.data), how, Shot._fields], sort_keys=True)
        name = f"{run.sequence}-{run.n}-{run.method}-{run.frames[0]}".replace(" ", "_").replace(",", "")
        return self.folder / f"{name}-{hashlib.sha256(parts.encode()).hexdigest()[:16]}.json"

    def _clip(self, run: Run, samples: Sequence[images.Sample]) -> Made:
        reports: list[FrameReport] = []
        maps = None if run.method == NO_MAPS else [sample.labels for sample in samples]
        with _changed([*_ALL_CARRIED, *VARIANTS[run.method]] if run.method in VARIANTS else []):
            clip = fit_video(
                [sample.image for sample in samples], maps, run.n, recipe=self.config, on_frame=reports.append
            )
        data, sizes = clip.to_bytes(), list(clip.frame_bytes)
        sizes[0] += len(data) - sum(sizes)  # what is not of a frame
        known = [
            {"bytes": size, "is_key": int(r.is_key), "seconds": r.seconds, "born": r.born, "changed": share}
            for size, r, share in zip(sizes, reports, _changed_shares(data), strict=True)
        ]
        return Made([data], [scene.render() for scene in clip], known)

    def _files(self, run: Run, samples: Sequence[images.Sample]) -> Made:
        """Fit each frame by itself, as `kcgs fit` does."""
        made = Made([], [], [])
        for image, labels in samples:
            start = time.process_time()
            if run.method == BYTES:
                data, fitted = fit_bytes(image, labels, run.most, recipe=self.config).data, math.nan
            else:
                result = fit(image, labels, run.n, recipe=self.config)
                fitted = time.process_time() - start
                quality = quality_for(max(entry.psnr for entry in result.history))
                data = compress(result.scene, image, quality=quality).data
            seconds = time.process_time() - start
            made.files.append(data)
            made.shown.append(decode(data).scene.render())
            made.known.append({"bytes": len(data), "is_key": 1, "seconds": seconds, "fit_seconds": fitted})
        return made

    def _sparse(self, run: Run, samples: Sequence[images.Sample]) -> tuple[list[bytes], list[Shot]]:
        """Fit every second frame, and show what lies between."""
        made = self._clip(run, samples)
        clip, shots = Clip.from_bytes(made.files[0]), list[Shot]()
        for place, frame in enumerate(run.frames[:-1]):
            ((target, labels),) = self.samples(run.sequence, (frame + 1,))
            shown = {
                BETWEEN: clip.render(place + 0.5),
                MEAN: (made.shown[place] + made.shown[place + 1]) / 2,
                MEAN_PHOTO: (samples[place].image + samples[place + 1].image) / 2,
            }
            for method, image in shown.items():
                figures = float(psnr(image, target)), _edges(image, target, labels)
                shots.append(Shot(run.sequence, run.n, method, frame + 1, math.nan, *figures))
        return made.files, shots


def _stream(run: Run, samples: Sequence[images.Sample]) -> Made:
    """Encode all frames by another codec; nothing where it cannot go as low."""
    try:
        made = _video_codecs.encode_at([sample.image for sample in samples], CODECS[run.method], run.most)
    except ValueError:
        return Made([], [], [])
    return Made([made.data], made.decoded, [{"bytes": len(made.data) / len(samples)}] * len(samples))


def _measured(run: Run, samples: Sequence[images.Sample], made: Made) -> Iterator[Shot]:
    before: tuple[int, images.Sample, Tensor] | None = None
    for frame, sample, shown, known in zip(
        run.frames[: len(made.shown)], samples, made.shown, made.known, strict=False
    ):
        figures: dict[str, Any] = {"psnr": float(psnr(shown, sample.image)), "ef_psnr": _edges(shown, *sample)}
        if before is not None and before[0] == frame - 1:
            figures |= flicker(before[2], shown, before[1], sample)
        yield Shot(run.sequence, run.n, run.method, frame, **known, **figures)
        before = frame, sample, shown


def flicker(before: Tensor, after: Tensor, first: images.Sample, second: images.Sample) -> dict[str, float]:
    """Compare a change between two frames with that of the photos, as fields of a Shot."""
    change = second.image - first.image
    error = ((after - before) - change).square().mean(0) * 255**2
    assert first.labels is not None and second.labels is not None
    band = edge_band(first.labels) | edge_band(second.labels)
    parts = {"flicker": error, "flicker_inside": error[~band], "flicker_contours": error[band]}
    figures = {name: float(part.mean()) for name, part in parts.items()}
    return figures | {"flicker_followed": _followed(before - first.image, after - second.image, first, second)}


def _followed(before: Tensor, after: Tensor, first: images.Sample, second: images.Sample) -> float:
    """Return how much the error at a place changes that moves with its region: what an eye sees that follows it."""
    height, width = before.shape[1:]
    x, y = torch.meshgrid(torch.arange(width) + 0.5, torch.arange(height) + 0.5, indexing="xy")
    total, count = 0.0, 0
    assert first.labels is not None
    for region in first.labels.unique().tolist():
        mask = first.labels == region
        (a, b, c), (d, e, f) = register(first.image, second.image, mask).tolist()
        u, v = a * x + b * y + c, d * x + e * y + f
        mask &= (u > 0) & (v > 0) & (u < width) & (v < height)
        grid = torch.stack([2 * u / width - 1, 2 * v / height - 1], -1)[None]
        moved = grid_sample(after[None], grid, padding_mode="border", align_corners=False)[0]
        total += float((moved - before).square().mean(0)[mask].sum())
        count += int(mask.sum())
    return total / max(count, 1) * 255**2


def _edges(shown: Tensor, target: Tensor, labels: Tensor | None) -> float:
    return float(ef_psnr(shown, target, labels)) if labels is not None and len(labels.unique()) > 1 else math.nan


def _changed_shares(data: bytes) -> list[float]:
    """Return of each frame which share of its Gaussians, but the new ones, is not where motion takes them."""
    header, records, _ = unpack(data)
    reader, shares = FrameReader(header), list[float]()
    before: Frame | None = None
    for record in records:
        frame = reader.read(record)
        if record.kind == KEY or before is None:
            shares.append(math.nan)
        else:
            stays = np.isin(frame.key, before.key)
            places = np.searchsorted(before.key, frame.key[stays])
            moved = move_gaussians(before.gaussians, before.region, expand(frame.numbers, header.size))
            pairs = zip(moved, frame.gaussians, strict=True)
            differs = [(old[places].astype(np.float32) != new[stays]).any(1) for old, new in pairs]
            shares.append(float(np.any(differs, axis=0).mean()) if stays.any() else math.nan)
        before = frame
    return shares


@contextmanager
def _changed(parts: Sequence[tuple[Any, str, Any]]) -> Iterator[None]:
    """Have parts of the encoder replaced for a while."""
    with ExitStack() as stack:
        for part in parts:
            stack.enter_context(patch.object(*part))
        yield


@lru_cache(maxsize=64)
def _sample(sequence: str, frame: int, data: Path | None, quick: bool) -> images.Sample:
    """Read a frame; without data a camera pans over a still image."""
    if data is not None:
        found = images.davis(data).sequence(sequence)[frame]
        step = QUICK_STRIDE if quick else 1
        return images.Sample(found.image[:, ::step, ::step].contiguous(), found.labels[::step, ::step].contiguous())
    image, labels = images.load(sequence, None, QUICK_STRIDE)
    assert labels is not None
    labels = (labels == labels.flatten().mode().values).long()
    (dx, dy), (height, width) = _PAN, (side - 8 * step for side, step in zip(labels.shape, (1, 2), strict=True))
    rows, columns = slice(dy * frame, dy * frame + height), slice(dx * frame, dx * frame + width)
    return images.Sample(image[:, rows, columns].contiguous(), labels[rows, columns].contiguous())


@lru_cache(maxsize=8)
def _warm_up(config: FitConfig) -> None:
    """Compile what a clip needs: no clock shall count it."""
    warm_up(config)
    ramp = torch.linspace(0.0, 1.0, 96).expand(3, 64, 96)
    labels = (ramp[0] > 0.6).long().contiguous()
    short = config.model_copy(update={"iterations": 20})
    fit_video([ramp, ramp.roll(2, 2)], [labels, labels.roll(2, 1)], 24, recipe=short)


def threads() -> str:
    """Say on how many threads a fit runs."""
    return f"Threads: {torch.get_num_threads()} of {os.cpu_count()}"
