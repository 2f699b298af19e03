"""What reports of fits have in common: tables, and where methods lose."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import product

from .cases import PUBLISHED, method
from .compare import QUANTITIES, Contest, counts, equal_bits, equal_n, mean_over, select, shared
from .eye import MEASURES
from .statistics import Summary
from .store import Row
from .tables import count, db, markdown, number, seconds, signed, similarity

_KINDS: dict[str, Callable[..., Summary | None]] = {"equal N": equal_n, "equal bits": equal_bits}
# columns of means: the field, and what writes it
COLUMNS: dict[str, tuple[str, Callable[[float], str]]] = {
    "N left": ("num_gaussians", lambda value: count(value) if value else ""),
    "PSNR": ("psnr", db),
    "MS-SSIM": ("ms_ssim", similarity),
    "EF-PSNR": ("ef_psnr", db),
    "edge SSIM": ("ef_ssim", similarity),
    "SSIMULACRA2": ("ssimulacra2", number),
    "butteraugli": ("butteraugli", number),
    "bytes": ("bytes", count),
    "of these map": ("map_bytes", count),
    "bits per pixel": ("bits_per_pixel", "{:.3f}".format),
    "PSNR decoded": ("decoded_psnr", db),
    "EF-PSNR decoded": ("decoded_ef_psnr", db),
    "s": ("seconds", seconds),
    "core s": ("core_seconds", seconds),
}
HOW_TEXT = "What the columns are, and how they are measured: docs/results.md. Each fit by itself: results.csv."


def what_was_run(rows: Sequence[Row]) -> str:
    """State images and seconds, and how to read what follows."""
    known = sum(row.seconds for row in rows if not math.isnan(row.seconds))
    images = ", ".join(dict.fromkeys(row.image for row in rows)) or "none"
    text = f"- Images: {images}.\n- {len(rows)} fits are there, of {known:,.0f} s in all."
    return "\n\n".join(filter(None, (text, short_runs(rows), HOW_TEXT)))


def short_runs(rows: Sequence[Row]) -> str:
    """Say that published recipes ran shorter than they were published."""
    ran = {(row.iterations, method(row.method).config().usual_iterations) for row in rows if row.method in PUBLISHED}
    short = " or ".join(f"{count(own)} of their {count(full)}" for own, full in sorted(ran) if own < full)
    return f"Published recipes ran {short} iterations: differences to them are not final." if short else ""


def means(rows: Sequence[Row], methods: Sequence[str], columns: Sequence[str] = tuple(COLUMNS)) -> str:
    """Means over the images that every method of an N has; other codecs have neither Gaussians nor iterations."""
    measured = [name for name in MEASURES if not math.isnan(mean_over(rows, name))]
    columns = [name for name in columns if COLUMNS[name][0] not in {*MEASURES} - {*measured}]
    lines = []
    for n, present, images in shared(rows, methods):
        for name in present if images else ():
            found = select(rows, name, n, images)
            line = [count(n) if n else "", f"`{name}`", count(found[0].iterations) if n else "", str(len(images))]
            fields = (COLUMNS[column] for column in columns)
            lines.append(line + [write(mean_over(found, field)) for field, write in fields])
    return markdown(["N", "method", "iterations", "images", *columns], lines)


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
    for contest, kind, n, found in _compared(rows, contests, only, quantities):
        defined = [(len(d.values), d.asked) for d in found.values() if d is not None]
        if defined:
            has, asked = (max(numbers) for numbers in zip(*defined, strict=True))
            line = [count(n), str(contest), kind, str(has) if has == asked else f"{has} of {asked}"]
            lines.append(line + [cell for q, d in found.items() for cell in _difference_cells(d, q)])
    return markdown(header, lines)


def losses(rows: Sequence[Row], contests: Sequence[Contest], only: Sequence[int] | None = None) -> str:
    """Say on which images a method is below the other, worst first."""
    lines = []
    for contest, kind, n, compared in _compared(rows, contests, only, tuple(QUANTITIES)):
        for quantity, found in compared.items():
            if found is not None and found.losses:
                lost = found.worst[: found.losses]
                which = ", ".join(f"{image} {difference(found.values[image], quantity)}" for image in lost)
                where = f"{kind}, N = {n:,}, {QUANTITIES[quantity]}"
                lines.append(f"- {contest}, {where}: {found.losses} of {len(found.values)}: {which}")
    return "\n".join(lines) or "Nowhere."


def difference(value: float, quantity: str) -> str:
    """Write a difference in dB or of SSIMs."""
    return signed(value) if quantity.endswith("psnr") or math.isnan(value) else f"{value:+.4f}"


def _compared(
    rows: Sequence[Row], contests: Sequence[Contest], only: Sequence[int] | None, quantities: Sequence[str]
) -> Iterator[tuple[Contest, str, int, dict[str, Summary | None]]]:
    for contest, (kind, compare) in product(contests, _KINDS.items()):
        for n in counts(rows, contest.ours) if only is None else only:
            yield contest, kind, n, {quantity: compare(rows, *contest, n, quantity) for quantity in quantities}


def _difference_cells(found: Summary | None, quantity: str) -> list[str]:
    if found is None or not found.is_complete:
        return [""] * 3
    low, centre, high = (difference(value, quantity) for value in (found.low, found.mean, found.high))
    return [centre, f"{low} to {high}" if low else "", f"{found.wins}-{found.losses}"]
