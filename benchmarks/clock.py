"""What do regions give where a clock ends the fit of a large photo?"""

from __future__ import annotations

import time
from pathlib import Path

from kcgs import fit
from kcgs.functional import ef_psnr, psnr
from kcgs.segment import segment

from .core.clocks import threads
from .core.compare import Comparison, losses_table
from .core.figures import Panel, save_lines
from .core.images import load
from .core.run import Job, Options, Page, Row
from .core.tables import means_table

# photos of Kodak side by side, and the seconds of each
SECONDS = {"1 x 2 photos": 20, "2 x 4 photos": 20, "4 x 8 photos": 60}
QUICK_SECONDS = 1
METHODS = ("best", "best-baseline")
NUM_GAUSSIANS = 1_000
QUICK_GAUSSIANS = 40
THREADS = 2
COMPARISON = Comparison("best", "best-baseline")
METHOD = f"""`fit(image, labels, {NUM_GAUSSIANS:,}, max_seconds=SECONDS)` on {THREADS} cores. `segment` makes the labels
before the clock starts; `best-baseline` has no regions. Images are photos of Kodak side by side."""


def measure(image: str, method: str, data: str, quick: bool) -> list[Row]:
    """Fit with a clock."""
    pixels = load(image, data, quick).image
    budget = QUICK_SECONDS if quick else SECONDS[image]
    with threads(THREADS):
        labels = segment(pixels)
        start = time.perf_counter()
        result = fit(pixels, labels, QUICK_GAUSSIANS if quick else NUM_GAUSSIANS, recipe=method, max_seconds=budget)
        seconds = time.perf_counter() - start
    render = result.scene.render()
    return [
        {
            "image": image, "method": method, "megapixels": float(f"{pixels[0].numel() / 1e6:.3g}"), "budget": budget,
            "seconds": seconds, "iterations": result.history[-1].iteration, "psnr": float(psnr(render, pixels)),
            "ef_psnr": float(ef_psnr(render, pixels, labels)),
        }
    ]  # fmt: skip


def jobs(options: Options) -> list[Job]:
    """Fit stitched photos; in the quick form a disc."""
    images = list(SECONDS)
    if options.quick:
        images = ["disc"]
    else:
        options.folder()  # raises without data
    return [{"image": image, "method": method, **options.image_arguments()} for image in images for method in METHODS]


def page(folder: Path, rows: list[Row]) -> Page:
    """Write the report."""
    save_lines(folder / "clock.png", [Panel("", rows, "megapixels", "psnr")], "method", "megapixels")
    of_method = {method: {row["image"]: row for row in rows if row["method"] == method} for method in METHODS}
    best, plain = (of_method[method] for method in METHODS)
    gains = [
        f"{row['psnr'] - plain[image]['psnr']:+.2f} dB at {row['megapixels']:g} megapixels in {row['budget']} seconds"
        for image, row in best.items()
        if image in plain
    ]
    answer = f"With a clock, regions change the PSNR of large photos by {', '.join(gains)}."
    table = means_table(rows, ["method"], "megapixels", ("psnr", "ef_psnr", "iterations", "seconds"))
    losses = losses_table(rows, [COMPARISON], ("psnr", "ef_psnr"), ["megapixels"])
    return Page(answer, "clock.png", table, losses, METHOD)
