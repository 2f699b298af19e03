"""What do automatic label maps gain?"""

from __future__ import annotations

import time
from pathlib import Path

from kcgs.segment import segment

from .core.compare import Comparison, at_equal_bits, differences, losses_table, mean_gain
from .core.figures import Panel, save_lines
from .core.fits import QUICK_ITERATIONS, measure_result, timed_fit
from .core.images import PHOTOS, load, names
from .core.run import Job, Options, Page, Row
from .core.tables import join_tables, means_table

COUNTS = (200, 400, 1_000)
# N of further fits without a map; at equal bytes their files are interpolated
BASELINE_COUNTS = (300, 650, 1_600)
MAP, NO_MAP = "map", "no map"
SAME_N, EQUAL_BITS = Comparison(MAP, NO_MAP), Comparison(MAP, f"{NO_MAP}, equal bits")
QUANTITIES = ("psnr", "ef_psnr")
DECODED = ("decoded_psnr", "decoded_ef_psnr")
METHOD = """Photos of BSDS. The map is what `kcgs.segment.segment(image)` finds; `best` with it stands beside
`best-baseline` with as many Gaussians, and beside the baseline's files at as many bytes, interpolated between its own
files of that photo; the map's bytes are in the file. EF-PSNR is within 5 pixels of the contours of the found map.
Table: PSNR / EF-PSNR in dB; at the same bytes of decoded files."""


def measure(image: str, n: int, methods: list[str], data: str, quick: bool) -> list[Row]:
    """Fit an image with and without the map of `segment`."""
    pixels, length = load(image, data, quick).image, {"iterations": QUICK_ITERATIONS} if quick else {}
    start = time.process_time()
    labels = segment(pixels)
    row = {"image": image, "n": n, "map_seconds": time.process_time() - start}
    rows = []
    for method in methods:
        recipe = "best" if method == MAP else "best-baseline"
        result, seconds = timed_fit(pixels, labels, n, (recipe, length))
        rows.append({**row, "method": method, **measure_result(result, seconds, pixels, labels)})
    return rows


def jobs(options: Options) -> list[Job]:
    """List fits of photos of BSDS; without data, of scikit-image."""
    images = ["astronaut"] if options.quick else [*PHOTOS] if options.data is None else names(options.data, "bsds")
    arguments = options.image_arguments()
    counts, more = ((60,), (120,)) if options.quick else (COUNTS, BASELINE_COUNTS)
    listing = [(n, [MAP, NO_MAP]) for n in counts] + [(n, [NO_MAP]) for n in more]
    return [{"image": image, "n": n, "methods": methods, **arguments} for n, methods in listing for image in images]


def page(folder: Path, rows: list[Row]) -> Page:
    """Write the report."""
    paired = [row for row in rows if row["n"] in {row["n"] for row in rows if row["method"] == MAP}]
    equal = [*paired, *at_equal_bits(rows, SAME_N, DECODED, [])]
    gains = [*differences(paired, [SAME_N], QUANTITIES, ["n"]), *differences(equal, [EQUAL_BITS], DECODED, ["n"])]
    panels = [Panel("same N, 95 % intervals", gains, "n", name) for name in QUANTITIES]
    panels += [Panel("equal bits, 95 % intervals", gains, "n", name) for name in DECODED]
    save_lines(folder / "maps.png", panels, "method", "n")
    fewest, most = (limit(row["n"] for row in paired) for limit in (min, max))
    few, many = ([row for row in paired if row["n"] == n] for n in (fewest, most))
    at_few, at_many = (" / ".join(f"{mean_gain(part, SAME_N, q):+.2f}" for q in QUANTITIES) for part in (few, many))
    at_bits = " / ".join(f"{mean_gain(equal, EQUAL_BITS, quantity, ['n']):+.2f}" for quantity in DECODED)
    answer = (
        f"With as many Gaussians, automatic maps change PSNR / EF-PSNR by {at_few} dB at N = {fewest:,} and by "
        f"{at_many} dB at N = {most:,}. With as many bytes, map included, the change is {at_bits} dB."
    )
    titles = {" - ".join(SAME_N): "gain at the same N", " - ".join(EQUAL_BITS): "gain at the same bytes"}
    lines = [row | {"method": titles[row["method"]]} for row in gains]
    for row in lines:
        row |= {q: row[d] for q, d in zip(QUANTITIES, DECODED, strict=True) if d in row}
    table = means_table([*paired, *lines], ["method"], "n", QUANTITIES)
    losses = losses_table(paired, [SAME_N], QUANTITIES, ["n"])
    losses_at_bits = losses_table(equal, [EQUAL_BITS], DECODED, ["n"])
    return Page(answer, "maps.png", table, join_tables(losses, losses_at_bits), METHOD, gains)
