"""A video in, a clip out."""

from __future__ import annotations

import itertools
import math
import operator
import os
from collections.abc import Callable, Iterable, Iterator
from fractions import Fraction
from typing import Any

import torch
from torch import Tensor

from kcgs._check import check_count, check_number
from kcgs._progress import Progress
from kcgs.clip import Clip
from kcgs.codec.clips.file import ClipHeader, Record
from kcgs.fitting import FitConfig
from kcgs.fitting.loop import check_problem

from .budget import Budget
from .journal import Journal
from .report import FrameReport

# Gaussians of a frame where nothing is said
_USUAL = 1000
OnFrame = Callable[[FrameReport], bool | None]


@torch.inference_mode(False)
@torch.enable_grad()
def fit_video(
    frames: Iterable[Any],
    label_maps: Any = None,
    num_gaussians: int | None = None,
    *,
    target_bytes: int | None = None,
    kbps: float | None = None,
    frame_rate: float | Fraction = 24,
    recipe: str | FitConfig = "best",
    seed: int = 0,
    key_interval: int = 250,
    on_frame: OnFrame | None = None,
    progress: bool = False,
    checkpoint: str | os.PathLike[str] | None = None,
    resume: bool = False,
    **settings: Any,
) -> Clip:
    r"""Fit Gaussians to a video, each frame from the one before.

    A key frame is fitted as a still. Each next frame starts from the last one as the file holds it: every region, its
    Gaussians and its contours, moves by an affine motion that is found on the frames. Contours move on to where the
    image is explained better; Gaussians that are missed least make room for those that newly visible parts need; a
    short descent changes what pays for its bits. Where that loses much, at a scene cut, a new key frame begins. So
    Gaussians keep their identity, and what did not change does not flicker.

    Convention: the same arguments, device and number of threads give the same clip, bit for bit. Two frames are in
    memory at a time. The clip takes what its file does, one to five bytes for each Gaussian of a frame.

    Args:
        frames: tensors :math:`(C, H, W)`, or what else :func:`kcgs.fit` takes, of one size.
        label_maps: one for each frame, an iterable of what :func:`kcgs.fit` takes as regions; or one alone, of the
            first frame, which is carried on; None: no regions. In an iterable None stands for a map that is carried.
        num_gaussians: N, the most that a frame may have. None: 1,000, of small frames one for each of their pixels, or
            with a budget as many as suit it.
        target_bytes: the clip is not larger, and nearly as large: frames get coarser or finer as they go. It needs to
            be known how many frames there are: `frames` has a length.
        kbps: thousands of bits per second, in place of `target_bytes`.
        frame_rate: frames per second, which the file keeps.
        recipe: of the key frames, as in :func:`kcgs.fit`.
        seed: as there.
        key_interval: the most frames from one key frame to the next, at least 1: it limits what a player reads to
            show any frame.
        on_frame: called after each frame with a :class:`FrameReport`; returning True ends the clip there.
        progress: show a bar.
        checkpoint: a file to which every frame is added when it is done; it knows the frames and maps by checksums.
        resume: go on from `checkpoint` where it exists; the result is that of an uninterrupted fit.
        settings: of the key frames, fields of :class:`kcgs.FitConfig`.

    Returns:
        The clip. Its scenes are those of its file.

    Raises:
        TypeError, ValueError: as :func:`kcgs.fit`, naming the frame; no frames; a budget too small for them; frames of
            different sizes; label maps that end before the frames; a checkpoint of another fit.
        OSError: a checkpoint that cannot be written.

    Example:
        >>> x = torch.arange(48)
        >>> blobs = [torch.exp(-((x - c) ** 2) / 50).expand(3, 32, 48) for c in (20, 22, 24)]
        >>> clip = fit_video(blobs, num_gaussians=40, iterations=50)
        >>> len(clip), clip.key_frames, clip[2].size
        (3, (0,), (32, 48))
    """
    from .encoder import VideoEncoder  # loads numba

    config = FitConfig.from_recipe(recipe, **settings)
    if num_gaussians is not None:
        check_count("num_gaussians", num_gaussians)
    check_count("key_interval", key_interval)
    rate = _check_rate(frame_rate)
    if resume and checkpoint is None:
        raise ValueError("resume needs checkpoint, a file to go on from; got None")
    if config.target_psnr is not None or config.max_seconds is not None:
        raise ValueError("target_psnr and max_seconds must be None for a video, whose key frames are alike")
    count = operator.length_hint(frames, 0) or None
    num_bytes = _check_budget(target_bytes, kbps, count, rate)
    given = {"num_gaussians": num_gaussians, "seed": seed, "key_interval": key_interval, "num_bytes": num_bytes}
    asked = {**given, "config": config.model_dump(), "frames": None if num_bytes is None else count}
    journal = None if checkpoint is None else Journal(checkpoint, asked, resume=resume)
    records: list[Record] = []
    header = encoder = None
    with Progress("fit the video", known=count is not None, shown=progress) as bar:
        for number, (image, labels) in enumerate(_pairs(frames, label_maps)):
            if header is None or encoder is None:
                header = ClipHeader((image.shape[1], image.shape[2]), image.shape[0], rate)
                budget = None if num_bytes is None or count is None else Budget(num_bytes, count, header, key_interval)
                usual = None if num_bytes is not None else min(_USUAL, image[0].numel())
                encoder = VideoEncoder(config, num_gaussians or usual, seed, key_interval, budget)
            elif (image.shape[1:], len(image)) != (torch.Size(header.size), header.channels):
                raise ValueError(f"frames must have one size; got {tuple(image.shape)} for frame {number}")
            elif num_bytes is not None and number == count:
                raise ValueError(f"frames must be as many as their length says, {count}; got more")
            if journal is not None and (done := journal.done(header, number, image, labels)) is not None:
                records.append(encoder.skip(image, labels, done))
                continue
            try:
                record, report = encoder.add(image, labels)
            except ValueError as error:
                raise ValueError(f"frame {number}: {error}") from error
            records.append(record)
            if journal is not None:
                journal.write(header, number, image, labels, record)
            if count:
                bar.update((number + 1) / count, f"frame {number + 1} of {count}, {report.psnr:.2f} dB")
            if on_frame is not None and on_frame(report):
                break
    if header is None:
        raise ValueError("frames must hold at least one frame; got none")
    return Clip(header, records)


def _pairs(frames: Iterable[Any], label_maps: Any) -> Iterator[tuple[Tensor, Tensor | None]]:
    """Check frames and label maps, one pair after another; a map that is carried on is None."""
    if label_maps is None or hasattr(label_maps, "ndim") or hasattr(label_maps, "num_regions"):
        label_maps = itertools.chain([label_maps], itertools.repeat(None))
    maps = iter(label_maps)
    for number, frame in enumerate(frames):
        try:
            labels = next(maps)
        except StopIteration:
            raise ValueError(f"label_maps must have one for each frame; got {number}, and a frame more") from None
        try:
            image, regions = check_problem(frame, labels)
        except (TypeError, ValueError) as error:
            raise type(error)(f"frame {number}: {error}") from error
        if regions is not None and regions.supersample > 1:
            raise ValueError(f"frame {number}: regions must have one label for each pixel")
        yield image.float(), None if regions is None else regions.labels


def _check_budget(target_bytes: object, kbps: object, count: int | None, rate: Fraction) -> int | None:
    """Return the bytes of the clip, or None."""
    if target_bytes is not None and kbps is not None:
        raise ValueError(f"target_bytes and kbps exclude each other; got {target_bytes!r} and {kbps!r}")
    if target_bytes is None and kbps is None:
        return None
    if count is None:
        raise ValueError("frames must have a length where target_bytes or kbps is given; got an iterator")
    if target_bytes is not None:
        return check_count("target_bytes", target_bytes)
    value = check_number("kbps", kbps, 0.0, unit="thousands of bits per second", above=True)
    return max(1, int(value * 125 * count / rate))


def _check_rate(value: object) -> Fraction:
    if isinstance(value, bool) or not isinstance(value, int | float | Fraction) or not math.isfinite(value):
        raise TypeError(f"frame_rate must be a number; got {value!r}")
    rate = Fraction(value).limit_denominator(1001)
    if not 0 < rate <= 1000:
        raise ValueError(f"frame_rate must be above 0 and at most 1000 frames per second; got {value!r}")
    return rate
