"""What do tens of thousands of Gaussians give?"""

from __future__ import annotations

import os
import time
from pathlib import Path
from statistics import fmean

import torch

from kcgs import FitConfig, fit
from kcgs.fitting import precompile

from .core.clocks import peak_megabytes, threads
from .core.cuda import megabytes, synchronize
from .core.figures import Panel, save_lines
from .core.fits import QUICK_ITERATIONS
from .core.goals import Goal, goals_table, missed_goals
from .core.images import choose, load
from .core.run import Job, Options, Page, Row
from .core.tables import group_by, join_sections, means_table

COUNTS = (10_000, 30_000, 50_000, 70_000)
QUICK_COUNTS = (100, 200)
# images made of four photos of Kodak each
LARGE = tuple(f"2 x 2 photos {k + 1}" for k in range(8))
# all photos of Kodak in one image
HUGE, HUGE_COUNT = "4 x 6 photos", 300_000
CPU, GPU = "CPU", "GPU"
# for Kodak on a GPU: N, least PSNR in dB, largest seconds
GOAL = (50_000, 48.5, 2.0)
# published results on Kodak with a GPU: method with its paper on arXiv, N, PSNR in dB, seconds
PRINTED: tuple[tuple[str, int, float, float | None], ...] = (
    ("GaussianImage++ (2512.19108)", 10_000, 35.41, None),
    ("Structure-Guided (2512.24018)", 30_000, 40.51, 132.0),
    ("Structure-Guided (2512.24018)", 70_000, 45.40, None),
    ("Fast-2DGS (2512.12774)", 50_000, 43.13, 10.0),
    ("SAD, sites of a soft Voronoi diagram (2604.21984)", 50_000, 46.0, 2.2),
)
METHOD = f"""`fit(image, None, N)` with its default settings, without compilation: the 24 photos of Kodak; images of
four of them side by side, {len(LARGE)} of them; and one of all 24, 9.4 megapixels, with {HUGE_COUNT:,} Gaussians.
Seconds are those of the call, on all cores of a CPU or on a GPU. MB is what a fit of the largest image adds at the
peak. As printed, on GPUs, with the paper on arXiv: {
    "; ".join(
        f"{name} {psnr:g} dB at N = {n:,}" + (f" in {seconds:g} s" if seconds else "")
        for name, n, psnr, seconds in PRINTED
    )
}."""


def measure(image: str, method: str, counts: list[int], data: str, quick: bool) -> list[Row]:
    """Fit an image several times, each time with more Gaussians."""
    device = "cuda" if method == GPU else "cpu"
    config = FitConfig(iterations=QUICK_ITERATIONS if quick else None)
    pixels, rows = load(image, data, quick).image.to(device), []
    with threads(os.cpu_count() or 1):
        precompile(config, device)
        for n in counts:
            start = time.perf_counter()
            result = fit(pixels, None, n, recipe=config)
            synchronize()
            rows.append(
                {
                    "image": image, "set": set_of(image), "method": method, "n": n, "psnr": result.psnr,
                    "seconds": time.perf_counter() - start,
                }
            )  # fmt: skip
    if image == HUGE:
        largest = data, quick, method, config, max(counts)
        rows[-1]["peak_MB"] = (
            megabytes(lambda: fit_by_name(image, *largest))
            if method == GPU
            else peak_megabytes(fit_by_name, image, *largest, warm_up=("kodim01", *largest[:-1], 100))
        )
    return rows


def fit_by_name(image: str, data: str, quick: bool, method: str, config: FitConfig, n: int) -> None:
    """Fit an image in a process whose memory is measured."""
    fit(load(image, data, quick).image.to("cuda" if method == GPU else "cpu"), None, n, recipe=config)


def set_of(image: str) -> str:
    """Return the name of an image's set, one of three."""
    return HUGE if image == HUGE else "2 x 2 photos" if image in LARGE else "Kodak"


def jobs(options: Options) -> list[Job]:
    """List fits of all images on a CPU, and on a GPU if there is one."""
    devices = [CPU, *([GPU] if torch.cuda.is_available() else [])]
    images = choose(options, "kodak")
    counts: dict[str, tuple[int, ...]] = {image: QUICK_COUNTS if options.quick else COUNTS for image in images}
    if not options.quick and options.data is not None:
        counts |= {image: COUNTS for image in LARGE} | {HUGE: (HUGE_COUNT,)}
    return [
        {"image": image, "method": method, "counts": counts[image], **options.image_arguments()}
        for method in devices
        for image in counts
    ]


def page(folder: Path, rows: list[Row]) -> Page:
    """Write the report."""
    panels = [
        Panel(f"{method}, {quantity}", group, "n", quantity, ("log", "linear" if quantity == "psnr" else "log"))
        for (method,), group in group_by([row for row in rows if row["set"] != HUGE], ["method"]).items()
        for quantity in ("psnr", "seconds")
    ]
    save_lines(folder / "many.png", panels, "set", "n")
    sentences, goals = [], []
    for (images, method), group in group_by(rows, ["set", "method"]).items():
        means = {
            n: [fmean(row[quantity] for row in group if row["n"] == n) for quantity in ("psnr", "seconds")]
            for n in sorted({int(row["n"]) for row in group})
        }
        few, many = min(means), max(means)
        sentences.append(
            f"{images} on {method}: {means[many][0]:.2f} dB at N = {many:,} in {means[many][1]:.1f} seconds."
        )
        if few < many:
            factor = means[many][1] / means[few][1]
            sentences.append(f"{many / few:.3g} times as many Gaussians as {few:,} take {factor:.2g} times as long.")
        if images == "Kodak" and method == GPU and GOAL[0] in means:
            psnr, seconds = means[GOAL[0]]
            name = f"Kodak, N = {GOAL[0]:,}"
            goals += [Goal(name, "psnr", GOAL[1], psnr, more_is_better=True), Goal(name, "seconds", GOAL[2], seconds)]
    table = means_table(rows, ["set", "method"], "n", ("psnr", "seconds", "peak_MB"))
    missing = "" if any(row["method"] == GPU for row in rows) else "No GPU was measured: that takes a CUDA device."
    losses = join_sections(missed_goals(goals), missing)
    return Page(" ".join(sentences), "many.png", join_sections(table, goals_table(goals)), losses, METHOD)
