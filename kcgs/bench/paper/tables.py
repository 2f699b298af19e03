"""Tables of the paper's experiments, and where methods lose in words."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from itertools import product
from typing import NamedTuple

from kcgs.bench.cells import count, db, markdown, seconds, signed

from .compare import QUANTITIES, Difference, by_picture, counts, equal_bits, equal_n, mean, select, shared
from .trials import Row

_WAYS: dict[str, Callable[..., Difference | None]] = {"equal N": equal_n, "equal bits": equal_bits}
BITS_TEXT = """Bytes are the size of the scene's `.kcgs` file: Gaussians, region ids, label map, contour widths, all
that a decoder needs, written by `kcgs.codec.encode(field, regions, quality=psnr + 14.5)`, without a look at the image.
*Decoded* figures are those of the picture that this file decodes to."""
EQUAL_BITS_TEXT = """At equal bits the decoded picture is compared with the other method's at the same number of bytes
of the same picture: its curve is interpolated linearly over the logarithm of the bytes, between its own files. Where
that curve does not reach so many bytes, or so few, on some of the pictures, there is no mean: which ones are left is no
chance."""


class Contest(NamedTuple):
    """A method and the one that it is held against."""

    ours: str
    other: str

    def __str__(self) -> str:
        return f"{self.ours} - {self.other}"


def similarity(value: float) -> str:
    """Write an SSIM."""
    return "" if math.isnan(value) else f"{value:.4f}"


def quality(rows: Sequence[Row], methods: Sequence[str], names: dict[str, str] | None = None) -> str:
    """Means over the pictures that every method has."""
    header = ["N", "method", "iterations", "pictures", "PSNR", "MS-SSIM", "EF-PSNR", "edge SSIM", "N left", "bytes"]
    header += ["of these map", "bits per pixel", "decoded PSNR", "decoded EF-PSNR", "s", "core s"]
    lines = []
    for n, present, pictures in shared(rows, methods):
        for name in present:
            found = [row for row in select(rows, name, n) if row.picture in pictures]
            if found:
                shown = name if names is None else names[name]
                line = [count(n), shown, count(found[0].iterations), str(len({row.picture for row in found}))]
                lines.append(line + _means(found))
    return markdown(header, lines)


def differences(
    rows: Sequence[Row],
    contests: Sequence[Contest],
    at: Sequence[int] | None = None,
    quantities: Sequence[str] = tuple(QUANTITIES),
) -> str:
    """Paired differences, a line each contest, N and way."""
    header = ["N", "difference", "at", "pictures"]
    for quantity in quantities:
        header += [QUANTITIES[quantity], "95 %", "won-lost"]
    lines = []
    for contest, (way, compare) in product(contests, _WAYS.items()):
        for n in counts(rows, contest.ours) if at is None else at:
            found = {q: compare(rows, *contest, n, q) for q in quantities}
            there = [d for d in found.values() if d is not None]
            if there:
                has, asked = (max(numbers) for numbers in zip(*((len(d.values), d.asked) for d in there), strict=True))
                line = [count(n), str(contest), way, str(has) if has == asked else f"{has} of {asked}"]
                lines.append(line + [cell for q, d in found.items() for cell in _difference_cells(d, q)])
    return markdown(header, lines)


def losses(rows: Sequence[Row], contests: Sequence[Contest], at: Sequence[int] | None = None) -> str:
    """Say on which pictures a method is below the other, worst first."""
    lines = []
    for contest, (way, compare) in product(contests, _WAYS.items()):
        for n, quantity in product(counts(rows, contest.ours) if at is None else at, QUANTITIES):
            found = compare(rows, *contest, n, quantity)
            if found is not None and found.losses:
                below = [p for p in found.worst if found.values[p] < 0][: found.losses]
                which = ", ".join(f"{p} {difference(found.values[p], quantity)}" for p in below)
                where = f"{way}, N = {n:,}, {QUANTITIES[quantity]}"
                lines.append(f"- {contest}, {where}: {found.losses} of {len(found.values)}: {which}")
    return "\n".join(lines) or "Nowhere."


def each(rows: Sequence[Row], methods: Sequence[str]) -> str:
    """One line a picture, N and method."""
    header = ["picture", "N", "method", "PSNR", "MS-SSIM", "EF-PSNR", "edge SSIM", "N left", "bytes", "of these map"]
    header += ["bits per pixel", "decoded PSNR", "decoded EF-PSNR", "s", "core s"]
    lines = []
    for picture in dict.fromkeys(row.picture for row in rows):
        here = [row for row in rows if row.picture == picture]
        for n, name in product(sorted({row.n for row in here}), methods):
            found = select(here, name, n)
            if found:
                lines.append([picture, count(n), name, *_means(found, spread=False)])
    return markdown(header, lines)


def unpaid(rows: Sequence[Row], ours: str, baseline: str) -> str:
    """Say where the bits of contours do not pay."""
    lines = []
    for n, quantity in product(counts(rows, ours), ("psnr", "ef_psnr")):
        found = equal_bits(rows, ours, baseline, n, quantity)
        if found is not None and found.is_complete:
            shares = [row.map_bytes / row.bytes for row in select(rows, ours, n)]
            word = "does not pay for itself" if found.mean < 0 else "pays for itself"
            if math.isnan(found.low):
                word += " on so few pictures as here"
            elif found.low < 0 < found.high:
                word = "is not shown to pay for itself or not to"
            lines.append(
                f"- N = {n:,}: the map is {100 * mean(shares):.1f} % of the bytes and {word} in "
                f"{QUANTITIES[quantity]}: {signed(found.mean)} dB at equal bits, {found.wins} won and "
                f"{found.losses} lost of {len(found.values)}"
            )
    return "\n".join(lines) or "Nothing to compare."


def rounding(rows: Sequence[Row]) -> str:
    """Say what the files cost at most."""
    worst = max(rows, key=lambda row: row.psnr - row.decoded_psnr)
    where = f"{worst.picture}, N = {worst.n:,}, {worst.method}"
    return f"Rounding costs a PSNR of at most {worst.psnr - worst.decoded_psnr:.2f} dB here ({where})."


def _means(found: list[Row], *, spread: bool = True) -> list[str]:
    cells = []
    for quantity in QUANTITIES:
        values = [v for v in by_picture(found, quantity).values() if not math.isnan(v)]
        write = db if quantity.endswith("psnr") else similarity
        deviation = f" ± {write(statistics.stdev(values))}" if spread and len(values) > 1 else ""
        cells.append(write(mean(values)) + deviation)
    cells += [count(mean(by_picture(found, q).values())) for q in ("num_gaussians", "bytes", "map_bytes")]
    cells.append(f"{mean(by_picture(found, 'bits_per_pixel').values()):.3f}")
    cells += [db(mean(by_picture(found, q).values())) for q in ("decoded_psnr", "decoded_ef_psnr")]
    return cells + [seconds(mean(by_picture(found, q).values())) for q in ("seconds", "core_seconds")]


def _difference_cells(found: Difference | None, quantity: str) -> list[str]:
    if found is None or not found.is_complete:
        return [""] * 3
    low, centre, high = (difference(value, quantity) for value in (found.low, found.mean, found.high))
    return [centre, f"{low} to {high}" if low else "", f"{found.wins}-{found.losses}"]


def difference(value: float, quantity: str) -> str:
    """Write a difference in dB or of SSIMs."""
    return signed(value) if quantity.endswith("psnr") or math.isnan(value) else f"{value:+.4f}"
