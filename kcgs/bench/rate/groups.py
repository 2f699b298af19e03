"""What each group measures, in order."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import torch
from torch import Tensor

from kcgs.bench.core.clocks import threads
from kcgs.bench.sizes import map_bytes
from kcgs.codec import encode
from kcgs.rate import compress

from .codecs import AVIF, AVIF_PSNR, present
from .pictures import (
    COUNTS,
    DAVIS_CURVE,
    KODAK_CURVE,
    MAPS,
    MATCHED,
    MOST_BYTES,
    PRECISION,
    QUICK_BYTES,
    QUICK_COUNTS,
    QUICK_TARGETS,
    SPEED,
    TARGETS,
    names,
    read,
    read_map,
)
from .points import DECODE, LABELS, LOSSLESS_WEBP, PLAIN, TUNED, Ask, Point
from .workshop import FIRST_QUALITY, Workshop, draw, timed

# some files of one picture; those that are not there, and may not be made, are left out
Step = Callable[[], list[Point]]
SPEED_THREADS = 2
# share of another file's bytes that is nearly as many
_NEAR = 0.98


def steps(group: str, workshop: Workshop) -> Iterator[tuple[str, Step]]:
    """List what a group measures, by name."""
    images = names(group, workshop.data, workshop.quick)
    if group == MATCHED:
        # without regions is the second thing to know, of all
        for image in images:
            yield image, partial(_matched, workshop, image)
        for image in images:
            yield f"{image}, no regions", partial(_matched_without, workshop, image)
    elif group in (DAVIS_CURVE, KODAK_CURVE):
        for image in images:
            for most in QUICK_TARGETS if workshop.quick else TARGETS:
                yield f"{image} {most:,}", partial(_on_curve, workshop, group, image, most)
    elif group == MAPS:
        for image in images:
            yield image, partial(_map, workshop, image)
    else:
        measured = {PRECISION: _precision, SPEED: _speed}[group]
        for image in images:
            for n in QUICK_COUNTS if workshop.quick else COUNTS:
                yield f"{image} N = {n:,}", partial(measured, workshop, image, n)


def _matched(workshop: Workshop, image: str) -> list[Point]:
    """Make other codecs' files, then kcgs' of no more bytes than each.

    A fit is made for the larger of AVIF's files. It is written again for the others, unless there is a file of nearly
    as many bytes already, or they could not go as low.
    """
    most = QUICK_BYTES if workshop.quick else MOST_BYTES
    others = _there([workshop.other(MATCHED, image, codec, most) for codec in present()])
    avif = sorted({p.bytes for p in others if p.codec in (AVIF, AVIF_PSNR)}, reverse=True) or [most]
    first = workshop.fitted(MATCHED, image, avif[0]) if len(others) == len(present()) else None
    if first is None:
        return others
    ours = [first, *(workshop.rewritten(first, smaller) for smaller in avif[1:])]
    for point in others:
        least = _NEAR * point.bytes if point.bytes <= most else 0.0
        if not any(one is not None and least <= one.bytes <= point.bytes for one in ours):
            ours.append(workshop.rewritten(first, point.bytes))
    return [*others, *_there(ours)]


def _matched_without(workshop: Workshop, image: str) -> list[Point]:
    ours = [
        p for p in _matched(Workshop(workshop.store, workshop.data, workshop.quick, makes=False), image) if p.regions
    ]
    return _there([workshop.fitted(MATCHED, image, ours[0].asked, regions=False)]) if ours else []


def _on_curve(workshop: Workshop, group: str, image: str, most: int) -> list[Point]:
    points = [workshop.other(group, image, codec, most, exact=False) for codec in present()]
    which = (True,) if workshop.quick else (True, False)
    return _there([*points, *(workshop.fitted(group, image, most, regions=regions) for regions in which)])


def _precision(workshop: Workshop, image: str, n: int) -> list[Point]:
    scene = workshop.scene(PRECISION, image, n)
    return [] if scene is None else _there([scene, workshop.rounded(scene)])


def _map(workshop: Workshop, image: str) -> list[Point]:
    from kcgs.codec.labels import encode_labels  # compiles loops

    def make(codec: str, size: Callable[[Tensor], int]) -> Point:
        labels = read_map(image, workshop.data)
        count, found = size(labels), int(torch.unique(labels).numel())
        return Point(MAPS, image, codec, 0, count, 8 * count / labels.numel(), regions=found)

    sizes = {LABELS: lambda labels: len(encode_labels(labels.numpy())), LOSSLESS_WEBP: map_bytes}
    asked = {codec: Ask(MAPS, image, codec, 0, workshop.quick) for codec in sizes}
    return _there([workshop.keep(asked[codec], 0, partial(make, codec, size)) for codec, size in sizes.items()])


def _speed(workshop: Workshop, image: str, n: int) -> list[Point]:
    """Time files of the scene that the group of precision keeps."""
    scene = workshop.scene(PRECISION, image, n)
    if scene is None:
        return []
    repeats = 1 if workshop.quick else 5

    def make(what: str) -> Point:
        assert scene is not None
        field, regions = workshop.load_scene(scene)
        picture, quality = read(PRECISION, image, workshop.data).image, scene.psnr + FIRST_QUALITY
        with threads(SPEED_THREADS):
            if what == TUNED:
                tuned = partial(compress, field, picture, regions, quality=quality, iterations=workshop.tuning)
                data, seconds = timed(tuned, repeats)
            else:
                data, seconds = timed(partial(encode, field, regions, quality=quality), repeats)
            if what == DECODE:
                seconds = timed(lambda: draw(data), 3 * repeats)[1]
        point = Point(SPEED, image, what, n, len(data), 8 * len(data) / picture[0].numel(), num_gaussians=len(field))
        return point._replace(decode_seconds=seconds) if what == DECODE else point._replace(encode_seconds=seconds)

    asked = [Ask(SPEED, image, what, n, workshop.quick) for what in (TUNED, PLAIN, DECODE)]
    return _there([workshop.keep(ask, [repeats, SPEED_THREADS], partial(make, ask.codec)) for ask in asked])


def _there(points: list[Point | None]) -> list[Point]:
    return [point for point in points if point is not None]
