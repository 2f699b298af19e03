"""What does each part of `best` gain?"""

from __future__ import annotations

from pathlib import Path

from .core.compare import Comparison, at_equal_bits, differences, losses_table, mean_gain
from .core.figures import save_differences
from .core.fits import Method, measure_fit, plan
from .core.images import choose
from .core.run import Job, Options, Page, Row
from .core.tables import means_table

COUNTS = (1_250, 7_500)
# N of further fits of `best`; at equal bytes their files are interpolated
CURVE = (1_000, 1_500, 6_000, 9_000)
METHODS: dict[str, Method] = {
    "best": ("best", {}),
    "random start": ("best", {"initializer": "random"}),
    "no densification": ("best", {"densify_from": 1.0}),
    "hard contours": ("best", {"softness": 0.0}),
    "contours as given": ("best", {"move_contours": False, "merge_regions": False}),
    "L1 loss": ("best", {"objective": "l1"}),
    "Adam of Image-GS": ("best", {"optimizer": "adam"}),
    "no regions": ("best-baseline", {}),
}
QUANTITIES = ("psnr", "ef_psnr")
DECODED = ("decoded_psnr", "decoded_ef_psnr")
PARTS = tuple(Comparison(name, "best") for name in list(METHODS)[1:])
EQUAL_BITS = tuple(Comparison(name, "best, equal bits") for name in list(METHODS)[1:])
METHOD = """First frames of DAVIS with the given masks; each row is `best` with one part changed. Table: the change
of PSNR / EF-PSNR in dB, at the same N and, of decoded files, at the same bytes; there `best` is interpolated between
its own files of that image."""

measure = measure_fit


def jobs(options: Options) -> list[Job]:
    """List the fits of every row, the smaller N first; without data, of photos of scikit-image."""
    images = choose(options, "davis")
    counts, curve = ((40,), (50,)) if options.quick else (COUNTS, CURVE)
    listing = [job for n in counts for job in plan(images, (n,), METHODS, options)]
    return listing + plan(images, curve, {"best": METHODS["best"]}, options)


def page(folder: Path, rows: list[Row]) -> Page:
    """Write the report."""
    counts = sorted({row["n"] for row in rows if row["method"] == "no regions"})
    rows_of_parts = [row for row in rows if row["n"] in counts]
    equal = list(rows)
    for part in PARTS:
        at_bytes = at_equal_bits(rows, part, DECODED, [])
        equal += [row | {"method": "best, equal bits", "part": part.first} for row in at_bytes]
    at_n = differences(rows_of_parts, PARTS, QUANTITIES, ["n"])
    at_bits = []
    for comparison in EQUAL_BITS:
        pair = [row for row in equal if comparison.first in (row["method"], row.get("part"))]
        at_bits += differences(pair, [comparison], DECODED, ["n"])
    lines = [{**row, "method": row["method"].removesuffix(" - best"), "case": f"N = {row['n']:,}"} for row in at_n]
    for row in at_bits:
        values = {q: row[d] for q, d in zip(QUANTITIES, DECODED, strict=True) if d in row}
        case = f"bytes of N = {row['n']:,}"
        lines.append({"method": row["method"].removesuffix(" - best, equal bits"), "case": case, **values})
    own_rows = [{**row, "method": row["method"].removesuffix(" - best")} for row in at_n]
    save_differences(folder / "ablation.png", own_rows, QUANTITIES, "n")
    psnr, ef_psnr = (
        {part.first: f"{-mean_gain(rows_of_parts, part, quantity, ['n']):.2f}" for part in PARTS}
        for quantity in QUANTITIES
    )
    answer = (
        f"Without densification the PSNR is {psnr['no densification']} dB lower, with Adam as in Image-GS "
        f"{psnr['Adam of Image-GS']} dB, with an L1 loss {psnr['L1 loss']} dB. Near contours, the EF-PSNR is "
        f"{ef_psnr['no regions']} dB lower without regions, {ef_psnr['hard contours']} dB with hard contours, "
        f"{ef_psnr['contours as given']} dB with contours as given."
    )
    table = means_table(lines, ["method"], "case", QUANTITIES, "+")
    ahead = losses_table(rows_of_parts, [Comparison("best", part.first) for part in PARTS], QUANTITIES, ["n"])
    return Page(answer, "ablation.png", table, ahead, METHOD, [*at_n, *at_bits])
