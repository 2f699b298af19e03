"""What do label maps gain that are found in the image itself?"""

from __future__ import annotations

import math
import time
from pathlib import Path

from torch import Tensor

from kcgs import Scene, fit
from kcgs.codec import decode, encode
from kcgs.functional import psnr
from kcgs.rate import quality_for
from kcgs.segment import segment

from .core.compare import Comparison, differences_table, losses_table, means_table, summary
from .core.figures import Panel, save_lines
from .core.fits import QUICK_ITERATIONS, measure_render
from .core.images import load, names
from .core.run import Job, Options, Page, Row

COUNTS = (400, 1_000)
# with every fourth image, at the first of the counts
OTHERS = ("felzenszwalb", "slic", "watershed", "kmeans")
OTHERS_STRIDE = 4
QUANTITIES = ("psnr", "ef_psnr")
COMPARISONS = (Comparison("map", "no map"), Comparison("map", "no map, equal bits"))
METHOD = """No map is given: each is what `kcgs.segment.segment(image, source)` finds. A fit of `best` with the map
stands beside `best-baseline` with as many Gaussians, and beside the baseline with as many Gaussians as the bytes of
the first file buy, its map included. EF-PSNR is within 5 pixels of the contours of the map that the fit ends with; a
map without contours has none. Figures at equal bits, and those of the map beside it, are of decoded files."""


def measure(image: str, n: int, sources: list[str], data: str, quick: bool) -> list[Row]:
    """Fit with each source's map and without."""
    pixels = load(image, data, quick).image
    iterations = QUICK_ITERATIONS if quick else None
    without_map = fit(pixels, None, n, recipe="best-baseline", iterations=iterations).scene
    size, rows = len(_file(without_map, pixels)), []
    for source in sources:
        start = time.process_time()
        labels = segment(pixels, source)
        seconds = time.process_time() - start
        with_map = fit(pixels, labels, n, recipe="best", iterations=iterations).scene
        file = _file(with_map, pixels)
        equal_n = max(1, round(n * len(file) / size))
        equal = fit(pixels, None, equal_n, recipe="best-baseline", iterations=iterations).scene
        equal_file = _file(equal, pixels)
        regions = with_map.regions
        band = None if regions is None or regions.num_regions == 1 else regions.labels
        for method, scene, data_bytes, count in (
            ("map", with_map, file, n), ("no map", without_map, b"", n),
            ("no map, equal bits", equal, equal_file, equal_n),
        ):  # fmt: skip
            render = decode(data_bytes).scene.render() if method != "no map" else scene.render()
            figures = measure_render(scene.render(), pixels, band)
            decoded = {f"decoded_{name}": value for name, value in measure_render(render, pixels, band).items()}
            rows.append({
                "image": image, "n": n, "source": source, "method": method, "gaussians": count, **figures, **decoded,
                "bytes": len(data_bytes) or size, "regions": 1 if regions is None else regions.num_regions,
                "map_seconds": seconds if method == "map" else math.nan,
            })  # fmt: skip
    return rows


def _file(scene: Scene, image: Tensor) -> bytes:
    return encode(scene, quality=quality_for(float(psnr(scene.render(), image))))


def jobs(options: Options) -> list[Job]:
    """Fit the photos of BSDS."""
    images = ["astronaut"] if options.quick else names(options.folder(), "bsds")
    listing = []
    for index, image in enumerate(images):
        for n in (60,) if options.quick else COUNTS:
            others = OTHERS if n == COUNTS[0] and index % OTHERS_STRIDE == 0 else ()
            job = {"image": image, "n": n, "sources": ["auto", *others]}
            listing.append({**job, **options.image_arguments()})
    return listing


def page(folder: Path, rows: list[Row]) -> Page:
    """Write the report."""
    cases = ["source", "n"]
    first, second = COMPARISONS
    decoded = tuple(f"decoded_{name}" for name in QUANTITIES)
    ranked = []
    for comparison, quantities in ((first, QUANTITIES), (second, decoded)):
        for quantity in quantities:
            for (source, n), gain in comparison.gains(rows, quantity, cases).items():
                names = {"source": f"{source}, N = {n:,}", "comparison": comparison}
                values = enumerate(sorted(gain.values.values()), 1)
                ranked += [{**names, "% of images": 100 * i / len(gain.values), quantity: value} for i, value in values]
    panels = [
        Panel(
            " - ".join(comparison),
            [row for row in ranked if row["comparison"] == comparison],
            "% of images",
            q,
            ("linear", "linear"),
        )
        for comparison, quantities in ((first, QUANTITIES), (second, decoded))
        for q in quantities
    ]
    save_lines(folder / "maps.png", panels, "source", "% of images", marker=False)
    tables = [differences_table(rows, [first], QUANTITIES, cases), differences_table(rows, [second], decoded, cases)]
    tables.append(means_table(rows, ["source", "n", "method"], ("gaussians", "regions", "bytes", "map_seconds")))
    automatic = [row for row in rows if row["source"] == "auto"]
    text = f"{summary(automatic, first, QUANTITIES, cases)} {summary(automatic, second, decoded, cases)}"
    losses = losses_table(rows, [first], QUANTITIES, cases), losses_table(rows, [second], decoded, cases)
    question = "What do label maps gain that are found in the image itself?"
    return Page(question, METHOD, text, "maps.png", tables, "\n\n".join(filter(None, losses)))
