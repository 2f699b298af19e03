"""Rows beside each other: of the same image, at the same N or at the same number of bits."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

from .statistics import Curve, Summary, interpolate, mean, summarize
from .store import Row

QUANTITIES = {"psnr": "PSNR", "ms_ssim": "MS-SSIM", "ef_psnr": "EF-PSNR", "ef_ssim": "edge SSIM"}
# an interval over fewer images says nothing of others
LEAST = 5
_TIES = {"psnr": 0.005, "ef_psnr": 0.005, "ms_ssim": 0.0001, "ef_ssim": 0.0005}


class Contest(NamedTuple):
    """A method and the one that it is held against."""

    ours: str
    other: str

    def __str__(self) -> str:
        return f"{self.ours} - {self.other}"


def counts(rows: Iterable[Row], method: str) -> list[int]:
    """N that a method was run with."""
    return sorted({row.n for row in rows if row.method == method})


def select(rows: Iterable[Row], method: str, n: int | None = None, images: Iterable[str] | None = None) -> list[Row]:
    """Return the rows of a method, of one N or of all, of some images or of all."""
    wanted = None if images is None else set(images)
    found = [row for row in rows if row.method == method and n in (None, row.n)]
    return [row for row in found if wanted is None or row.image in wanted]


def by_image(rows: Iterable[Row], quantity: str) -> dict[str, float]:
    """Average over seeds."""
    values: dict[str, list[float]] = {}
    for row in rows:
        values.setdefault(row.image, []).append(getattr(row, quantity))
    return {image: mean(found) for image, found in values.items()}


def mean_over(rows: Iterable[Row], quantity: str) -> float:
    """Average over seeds, then over images."""
    return mean(by_image(rows, quantity).values())


def complete(rows: Sequence[Row], methods: Iterable[str], n: int) -> list[str]:
    """Images that every method has at this N: means over others could not be compared."""
    has = [{row.image for row in select(rows, method, n)} for method in methods]
    return [image for image in dict.fromkeys(row.image for row in rows) if all(image in found for found in has)]


def shared(rows: Sequence[Row], methods: Sequence[str]) -> Iterator[tuple[int, list[str], list[str]]]:
    """Go through all N: yield each with the methods that were run with it, and the images that all of these have."""
    for n in sorted({n for name in methods for n in counts(rows, name)}):
        present = [name for name in methods if n in counts(rows, name)]
        yield n, present, complete(rows, present, n)


def sweep(rows: Sequence[Row], methods: Sequence[str]) -> tuple[list[int], list[str]]:
    """Return the N that figures show, and the images that all methods have at all of them.

    An N that fewer than half of the images have, or a single method, is left out: a line must not go from the mean
    over some images to the mean over others.
    """
    found = {n: images for n, present, images in shared(rows, methods) if len(present) > 1}
    most = max(map(len, found.values()), default=0)
    swept = {n: set(images) for n, images in found.items() if 2 * len(images) > most}
    everywhere = set.intersection(*swept.values()) if swept else set()
    return sorted(swept), sorted(everywhere)


def equal_n(rows: Sequence[Row], ours: str, other: str, n: int, quantity: str) -> Summary | None:
    """Compare scenes of as many Gaussians; None: no image has both."""
    first, second = (by_image(select(rows, name, n), quantity) for name in (ours, other))
    values = {image: value - second[image] for image, value in first.items() if image in second}
    return summarize(values, _TIES[quantity], least=LEAST)


def equal_bits(rows: Sequence[Row], ours: str, other: str, n: int, quantity: str) -> Summary | None:
    """Compare the decoded files with the other's at as many bytes, interpolated between its own of that image."""
    decoded = f"decoded_{quantity}"
    first, sizes = (by_image(select(rows, ours, n), name) for name in (decoded, "bytes"))
    both = {row.image for row in select(rows, other)}
    values = {
        image: value - interpolate(curve(rows, other, image, decoded), sizes[image])
        for image, value in first.items()
        if image in both
    }
    return summarize(values, _TIES[quantity], least=LEAST)


def curve(rows: Sequence[Row], method: str, image: str, quantity: str) -> Curve:
    """Return quality over bytes, averaged over seeds."""
    found = select(rows, method, images=[image])
    points = []
    for n in sorted({row.n for row in found}):
        same = select(found, method, n)
        points.append((mean(row.bytes for row in same), mean(getattr(row, quantity) for row in same)))
    return sorted(points)
