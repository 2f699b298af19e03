"""How good are files of so many bytes, beside those of other codecs?"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from statistics import fmean

import numpy as np
from scipy.interpolate import PchipInterpolator

from kcgs import evaluate
from kcgs.rate import fit_bytes

from .core.codecs import CODECS, available_codecs, decode_file, largest_file
from .core.compare import (
    Comparison,
    at_equal_bits,
    differences_table,
    format_value,
    group_by,
    losses_table,
    markdown,
    means_table,
    summary,
    values_of,
)
from .core.figures import Panel, save_lines
from .core.fits import METRICS, QUICK_ITERATIONS, measure_render
from .core.images import load, load_mapped, names
from .core.run import Job, Options, Page, Row

# map, objective
OURS = {"kcgs": (True, "psnr"), "kcgs, no regions": (False, "psnr"), "kcgs, ms-ssim": (True, "ms-ssim")}
BYTES = {"DAVIS": (2_000, 4_000, 8_000, 16_000, 32_000), "Kodak": (3_932, 7_372, 14_745, 24_576, 39_321)}
QUICK_BYTES = (450, 900)
QUANTITIES = tuple(METRICS)
COMPARISONS = (
    *(Comparison("kcgs", other) for other in ("kcgs, no regions", *CODECS)),
    Comparison("kcgs, no regions", "AVIF, tune=psnr"),
    Comparison("kcgs, ms-ssim", "AVIF"),
)
# mean PSNR over Kodak's 24 photos by bits per pixel, as the authors of these codecs printed them
PRINTED = {
    "VTM": {0.08: 27.55, 0.15: 29.49, 0.3: 32.08, 0.5: 34.37},
    "C3": {0.08: 27.06, 0.15: 29.05, 0.3: 31.71, 0.5: 34.22},
    "BPG": {0.08: 26.68, 0.15: 28.52, 0.3: 31.01, 0.5: 33.31},
    "RECOMBINER": {0.08: 26.37, 0.15: 28.09, 0.3: 30.27, 0.5: 32.04},
    "GaussianImage++": {0.15: 25.3},
    "Cool-chic 5": {0.0839: 27.44, 0.2186: 30.86, 0.4819: 34.52},
}
METHOD = """Bytes are those of real files, everything in them included. `kcgs` is `kcgs.rate.fit_bytes` with the given
map on DAVIS, and with the one that `segment` finds on Kodak; `kcgs, no regions` is the same without a map, `kcgs,
ms-ssim` with that objective. Other codecs make their largest file of at most the bytes that were asked for, or their
smallest: JPEG optimized and progressive, 4:2:0 or 4:4:4, WebP with method 6, AVIF with speed 4. *Equal bits* compares
with the other's quality at as many bytes, interpolated between its own files of that image. BD-rate is how many more
bytes kcgs takes for the same PSNR, the mean over the qualities that both have (monotone cubics over the logarithm of
the bytes). Printed figures are means over all 24 photos of Kodak, so they compare only with means over all of
these."""


def measure(image: str, group: str, method: str, target_bytes: int, data: str, quick: bool) -> list[Row]:
    """Make a file and measure it."""
    pixels, labels = load(image, data, quick)
    start = time.process_time()
    if method in OURS:
        with_map, objective = OURS[method]
        regions = load_mapped(image, data, quick)[1] if with_map else None
        iterations = QUICK_ITERATIONS if quick else None
        result = fit_bytes(pixels, regions, target_bytes, objective=objective, iterations=iterations)
        size, render = len(result.data), result.scene.render()
        ssimulacra2 = evaluate(result.scene, pixels, labels).get("ssimulacra2")
    else:
        file = largest_file(method, pixels, target_bytes)
        size, render, ssimulacra2 = len(file), decode_file(file), None
    row = {"group": group, "image": image, "method": method, "target_bytes": target_bytes, "bytes": size}
    row |= {"bpp": 8 * size / pixels[0].numel(), "core_seconds": time.process_time() - start}
    return [{**row, **measure_render(render, pixels, labels), "ssimulacra2": ssimulacra2}]


def jobs(options: Options) -> list[Job]:
    """Make files of DAVIS and Kodak."""
    methods = [*(["kcgs"] if options.quick else OURS), *available_codecs()]
    if options.quick:
        files = [("DAVIS", "disc", size) for size in QUICK_BYTES]
    else:
        files = [
            (group, image, size)
            for group, sizes in BYTES.items()
            for size in sizes
            for image in names(options.folder(), group.lower())
        ]
    arguments = options.image_arguments()
    return [
        {"group": group, "image": image, "target_bytes": size, "method": method, **arguments}
        for group, image, size in files
        for method in methods
    ]


def bd_rate(ours: list[Row], other: list[Row], quantity: str = "psnr") -> float | None:
    """Return how many % more bytes ours takes for the same quality, Bjontegaard's measure; None: no overlap."""
    curves: list[tuple[float, float, Callable[..., float]]] = []
    for rows in (ours, other):
        # a file that a smaller one beats is no part of the curve
        rising: list[tuple[float, float]] = []
        for row in sorted(rows, key=lambda row: row["bytes"]):
            if not rising or row[quantity] > rising[-1][0]:
                rising.append((row[quantity], np.log(row["bytes"])))
        if len(rising) < 2:
            return None
        curves.append((rising[0][0], rising[-1][0], PchipInterpolator(*zip(*rising, strict=True)).integrate))
    low, high = max(curve[0] for curve in curves), min(curve[1] for curve in curves)
    if low >= high:
        return None
    areas = [integrate(low, high) for _, _, integrate in curves]
    return float(100 * np.expm1((areas[0] - areas[1]) / (high - low)))


def page(folder: Path, rows: list[Row]) -> Page:
    """Write the report."""
    groups = {str(group): group_rows for (group,), group_rows in group_by(rows, ["group"]).items()}
    equal = list(rows)
    for comparison in COMPARISONS:
        equal += at_equal_bits(rows, comparison, QUANTITIES, ["group"])
    comparisons = [Comparison(ours, f"{other}, equal bits") for ours, other in COMPARISONS]
    cases, lines = ["group", "target_bytes"], []
    for group, group_rows in groups.items():
        by_image = group_by(group_rows, ["image"])
        images = {str(image): group_by(files, ["method"]) for (image,), files in by_image.items()}
        for ours, other in COMPARISONS:
            pairs = {i: (m[ours,], m[other,]) for i, m in images.items() if (ours,) in m and (other,) in m}
            rates = {image: rate for image, pair in pairs.items() if (rate := bd_rate(*pair)) is not None}
            if rates:
                worst = max(rates, key=rates.__getitem__)
                numbers = f"{fmean(rates.values()):+.1f} %", f"{worst} {rates[worst]:+.1f} %"
                lines.append([group, f"{ours} - {other}", str(len(rates)), *numbers])
    panels = [Panel(group, files, "bpp", name) for group, files in groups.items() for name in ("psnr", "ms_ssim")]
    save_lines(folder / "rate.png", panels, "method", "target_bytes")
    tables = [markdown(["images", "files", "number", "BD-rate, mean", "worst"], lines)] if lines else []
    tables.append(differences_table(equal, comparisons, QUANTITIES, cases))
    columns = ("bytes", "bpp", *QUANTITIES, "ssimulacra2", "core_seconds")
    tables.append(means_table(rows, ["group", "target_bytes", "method"], columns))
    if "Kodak" in groups:
        tables.append(_printed(groups["Kodak"]))
    sentences = "\n".join(
        f"- {text}" for comparison in comparisons if (text := summary(equal, comparison, QUANTITIES, cases))
    )
    question = "How good are files of so many bytes, beside those of other codecs?"
    return Page(question, METHOD, sentences, "rate.png", tables, losses_table(equal, comparisons, QUANTITIES, cases))


def _printed(rows: list[Row]) -> str:
    """Lay out mean PSNR on Kodak beside printed figures."""
    measured: dict[str, dict[float, float]] = {}
    for (method, _), files in group_by(rows, ["method", "target_bytes"]).items():
        measured.setdefault(str(method), {})[round(fmean(values_of(files, "bpp")), 4)] = fmean(values_of(files, "psnr"))
    lines = [
        [f"{method}, {len(group_by(rows, ['image']))} photos" if method in measured else f"{method}, as printed",
         ", ".join(f"{format_value('psnr', psnr)} at {rate:g}" for rate, psnr in sorted(curve.items()))]
        for method, curve in {**measured, **PRINTED}.items()
    ]  # fmt: skip
    return markdown(["Kodak", "PSNR at bits per pixel"], lines)
