"""What reports of fits have in common: texts, tables, and where methods lose."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from itertools import product

from .cases import Method
from .compare import QUANTITIES, Contest, by_image, counts, equal_bits, equal_n, mean_over, select, shared
from .statistics import Summary, mean
from .store import Row
from .tables import count, db, markdown, seconds, signed, similarity

_WRITERS: dict[str, Callable[[float], str]] = {
    **dict.fromkeys(("psnr", "ef_psnr", "decoded_psnr", "decoded_ef_psnr"), db),
    **dict.fromkeys(("ms_ssim", "ef_ssim"), similarity),
    **dict.fromkeys(("num_gaussians", "bytes", "map_bytes"), count),
    **dict.fromkeys(("seconds", "core_seconds"), seconds),
    "bits_per_pixel": "{:.3f}".format,
}
_FIELDS = ["PSNR", "MS-SSIM", "EF-PSNR", "edge SSIM", "N left", "bytes", "of these map", "bits per pixel"]
_FIELDS += ["decoded PSNR", "decoded EF-PSNR", "s", "core s"]
_FILE_FIELDS = ["num_gaussians", "bytes", "map_bytes", "bits_per_pixel", "decoded_psnr", "decoded_ef_psnr"]
_FILE_FIELDS += ["seconds", "core_seconds"]
_KINDS: dict[str, Callable[..., Summary | None]] = {"equal N": equal_n, "equal bits": equal_bits}
METRICS_TEXT = """PSNR and MS-SSIM are over the whole image, EF-PSNR and edge SSIM within 5 pixels of the contours of
the given map, for every method alike; decibels, of values clipped to [0, 1]. `paper` is the paper's method,
`gaussian-image` its baseline without clamp and `gaussian-image-clamp` with it, `image-gs` Image-GS on our renderer,
`best` ours, and `best-baseline` ours with the regions off, the baseline improved as much. All run on the same kernel.
Differences are paired by image, above zero where the first is better; intervals are 95 %, by bootstrap over images,
widened for their small number, where there are five or more. Seconds are wall time of a fit, which other work on the
machine slows; core s is its processor time. *N left* are the Gaussians that the end of a fit leaves."""
BITS_TEXT = """Bytes are the size of the scene's `.kcgs` file: Gaussians, region ids, label map, contour widths, all
that a decoder needs, written by `kcgs.codec.encode(scene, quality=psnr + 14.5)`, without a look at the image.
*Decoded* figures are those of the image that this file decodes to."""
EQUAL_BITS_TEXT = """At equal bits the decoded image is compared with the other method's at the same number of bytes
of the same image: its curve is interpolated linearly over the logarithm of the bytes, between its own files. Where
that curve does not reach so many bytes, or so few, on some of the images, there is no mean: which ones are left is no
chance."""


def what_was_run(rows: Sequence[Row], methods: Sequence[Method]) -> str:
    """State images, iterations and seconds."""
    lines = [f"- Images: {', '.join(dict.fromkeys(row.image for row in rows)) or 'none'}."]
    for full in sorted({method.config().iterations for method in methods if method.is_published}):
        names = [m.name for m in methods if m.is_published and m.config().iterations == full]
        ran = _iterations(rows, names)
        if ran == f"{full:,}":
            lines.append(f"- Published recipes: their own {full:,} iterations.")
        elif ran:
            lines.append(
                f"- Published recipes: {ran} iterations, not {full:,}, with their schedule shortened and larger "
                "steps, by the recipes' own rule: not the published figures."
            )
    ours = _iterations(rows, [method.name for method in methods if not method.is_published])
    lines += [f"- Ours: {ours} iterations."] if ours else []
    known = sum(row.seconds for row in rows if not math.isnan(row.seconds))
    lines.append(f"- {len(rows)} fits are there, of {known:,.0f} s in all.")
    return "\n".join(lines)


def quality(rows: Sequence[Row], methods: Sequence[str], names: dict[str, str] | None = None) -> str:
    """Means over the images that every method has."""
    lines = []
    for n, present, images in shared(rows, methods):
        for name in present if images else ():
            found = select(rows, name, n, images)
            shown = name if names is None else names[name]
            lines.append([count(n), shown, count(found[0].iterations), str(len(images)), *_cells(found)])
    return markdown(["N", "method", "iterations", "images", *_FIELDS], lines)


def differences(
    rows: Sequence[Row],
    contests: Sequence[Contest],
    only: Sequence[int] | None = None,
    quantities: Sequence[str] = tuple(QUANTITIES),
) -> str:
    """Paired differences, a line for each contest, N and kind; `only` at these N."""
    header = ["N", "difference", "at", "images"]
    for quantity in quantities:
        header += [QUANTITIES[quantity], "95 %", "won-lost"]
    lines = []
    for contest, (kind, compare) in product(contests, _KINDS.items()):
        for n in counts(rows, contest.ours) if only is None else only:
            found = {q: compare(rows, *contest, n, q) for q in quantities}
            defined = [(len(d.values), d.asked) for d in found.values() if d is not None]
            if defined:
                has, asked = (max(numbers) for numbers in zip(*defined, strict=True))
                line = [count(n), str(contest), kind, str(has) if has == asked else f"{has} of {asked}"]
                lines.append(line + [cell for q, d in found.items() for cell in _difference_cells(d, q)])
    return markdown(header, lines)


def losses(rows: Sequence[Row], contests: Sequence[Contest], only: Sequence[int] | None = None) -> str:
    """Say on which images a method is below the other, worst first."""
    lines = []
    for contest, (kind, compare) in product(contests, _KINDS.items()):
        for n, quantity in product(counts(rows, contest.ours) if only is None else only, QUANTITIES):
            found = compare(rows, *contest, n, quantity)
            if found is not None and found.losses:
                below = [image for image in found.worst if found.values[image] < 0][: found.losses]
                which = ", ".join(f"{image} {difference(found.values[image], quantity)}" for image in below)
                where = f"{kind}, N = {n:,}, {QUANTITIES[quantity]}"
                lines.append(f"- {contest}, {where}: {found.losses} of {len(found.values)}: {which}")
    return "\n".join(lines) or "Nowhere."


def each(rows: Sequence[Row], methods: Sequence[str]) -> str:
    """One line per image, N and method."""
    lines = []
    for image in dict.fromkeys(row.image for row in rows):
        for n, name in product(sorted({row.n for row in rows if row.image == image}), methods):
            found = select(rows, name, n, [image])
            if found:
                lines.append([image, count(n), name, *_cells(found)])
    return markdown(["image", "N", "method", *_FIELDS], lines)


def unpaid(rows: Sequence[Row], ours: str, baseline: str) -> str:
    """Say where the bits of contours do not pay."""
    lines = []
    for n, quantity in product(counts(rows, ours), ("psnr", "ef_psnr")):
        found = equal_bits(rows, ours, baseline, n, quantity)
        if found is not None and found.is_complete:
            shares = [row.map_bytes / row.bytes for row in select(rows, ours, n)]
            word = "does not pay for itself" if found.mean < 0 else "pays for itself"
            if math.isnan(found.low):
                word += " on so few images as here"
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
    where = f"{worst.image}, N = {worst.n:,}, {worst.method}"
    return f"Rounding costs a PSNR of at most {worst.psnr - worst.decoded_psnr:.2f} dB here ({where})."


def difference(value: float, quantity: str) -> str:
    """Write a difference in dB or of SSIMs."""
    return signed(value) if quantity.endswith("psnr") or math.isnan(value) else f"{value:+.4f}"


def _iterations(rows: Sequence[Row], methods: Sequence[str]) -> str:
    return " and ".join(f"{n:,}" for n in sorted({row.iterations for row in rows if row.method in methods}))


def means(rows: Sequence[Row], names: Sequence[str]) -> list[str]:
    """Write means over images of fields, by name."""
    return [_WRITERS[name](mean_over(rows, name)) for name in names]


def _cells(found: Sequence[Row]) -> list[str]:
    """Write all means; of several images also the standard deviation."""
    cells = []
    for quantity in QUANTITIES:
        values = [value for value in by_image(found, quantity).values() if not math.isnan(value)]
        write = _WRITERS[quantity]
        cells.append(write(mean(values)) + (f" ± {write(statistics.stdev(values))}" if len(values) > 1 else ""))
    return cells + means(found, _FILE_FIELDS)


def _difference_cells(found: Summary | None, quantity: str) -> list[str]:
    if found is None or not found.is_complete:
        return [""] * 3
    low, centre, high = (difference(value, quantity) for value in (found.low, found.mean, found.high))
    return [centre, f"{low} to {high}" if low else "", f"{found.wins}-{found.losses}"]
