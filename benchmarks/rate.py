"""How good are files of so many bytes, beside those of other codecs?"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from statistics import fmean

import numpy as np
from scipy.interpolate import PchipInterpolator

from kcgs.functional import ssimulacra2
from kcgs.rate import fit_bytes

from .core.codecs import available_codecs, decode_file, largest_file
from .core.compare import Comparison, at_equal_bits, count_wins, differences, losses_table, mean_gain
from .core.figures import Panel, save_lines
from .core.fits import QUICK_ITERATIONS, REPORTED, measure_render
from .core.images import PHOTOS, load, load_mapped, names
from .core.run import Job, Options, Page, Row
from .core.tables import group_by, means_table, values_of

PSNR, REGIONS, EYE = "kcgs, psnr, no regions", "kcgs, psnr", "kcgs"
# whether the file may hold a map, and its objective
OURS = {PSNR: (False, "l2"), REGIONS: (True, "l2"), EYE: (True, "ms-ssim")}
# 0.08, 0.15, 0.3, 0.5 and 0.8 bits per pixel of Kodak
BYTES = (3_932, 7_372, 14_745, 24_576, 39_321)
# sizes for methods that make fewer files of Kodak; the report of `maps` has files for PSNR with found maps
KODAK_BYTES = {EYE: BYTES[1:4], REGIONS: ()}
QUICK_BYTES = (450, 900)
QUANTITIES = (*REPORTED, "ssimulacra2")
AVIF_PSNR = "AVIF, tune=psnr"
COMPARISONS = (
    Comparison(REGIONS, PSNR),
    *(Comparison(PSNR, other) for other in ("JPEG", "WebP", AVIF_PSNR)),
    *(Comparison(EYE, other) for other in ("JPEG", "WebP", "AVIF")),
)
CASES = ["group", "target_bytes"]
# mean PSNR in dB over Kodak's 24 photos at BYTES, from curves that the authors of C3 published
PRINTED = {
    "VTM": (27.55, 29.49, 32.08, 34.37),
    "C3": (27.06, 29.05, 31.71, 34.22),
    "BPG": (26.68, 28.52, 31.01, 33.31),
    "RECOMBINER": (26.37, 28.09, 30.27, 32.04),
}
METHOD = """All of Kodak, and first frames of DAVIS with the given masks. `kcgs` is `kcgs.rate.fit_bytes` with its
defaults, so for the eye, with the given map or the one that `segment` finds; `kcgs, psnr` is the same with that
objective. Other codecs make their largest file of at most so many bytes; where that is impossible, the table
leaves the image out, and has the number of the others behind the mean: JPEG optimized and progressive, 4:2:0 or 4:4:4,
WebP with method 6, AVIF with speed 4. Table: PSNR in dB / SSIMULACRA2; sizes are 0.08, 0.15, 0.3, 0.5 and 0.8 bits per
pixel of Kodak. Figures *as printed* are over the same 24 photos, interpolated between those that the authors of C3
(arXiv 2312.02753) published with their program, in `baselines/kodak.py`. BD-rate is how many more bytes the first
takes for the same PSNR (monotone cubics over the logarithm of the bytes). Losses are at equal bits: the other's quality
is interpolated between its own files of that image."""


def measure(image: str, group: str, method: str, sizes: list[int], data: str, quick: bool) -> list[Row]:
    """Make files and measure them; the searches of a codec for several sizes share their trial files."""
    pixels, labels = load(image, data, quick)
    rows = []
    for target_bytes in sizes:
        start = time.process_time()
        if method in OURS:
            with_map, objective = OURS[method]
            regions = load_mapped(image, data, quick)[1] if with_map else None
            iterations = QUICK_ITERATIONS if quick else None
            result = fit_bytes(pixels, regions, target_bytes, objective=objective, iterations=iterations)
            size, render = len(result.data), result.scene.render()
        else:
            file = largest_file(method, pixels, target_bytes)
            size, render = len(file), decode_file(file)
        row = {"group": group, "image": image, "method": method, "target_bytes": target_bytes, "bytes": size}
        row |= {"bpp": 8 * size / pixels[0].numel(), "core_seconds": time.process_time() - start}
        rows.append(row | measure_render(render, pixels, labels) | {"ssimulacra2": float(ssimulacra2(render, pixels))})
    return rows


def jobs(options: Options) -> list[Job]:
    """List files of DAVIS and Kodak; without data, of photos of scikit-image."""
    arguments, codecs = options.image_arguments(), available_codecs()
    if options.quick:
        methods = (PSNR, EYE, *codecs)
        return [{"group": "disc", "image": "disc", "method": m, "sizes": QUICK_BYTES, **arguments} for m in methods]
    groups = {"photos": [*PHOTOS]}
    if options.data is not None:
        groups = {group: names(options.data, group.lower()) for group in ("DAVIS", "Kodak")}
    return [
        {"group": group, "image": image, "method": method, "sizes": sizes, **arguments}
        for group, images in groups.items()
        for image in images
        for method, sizes in {
            **dict.fromkeys((*OURS, *codecs), BYTES),
            **(KODAK_BYTES if group == "Kodak" else {}),
        }.items()
        if sizes
    ]


def bd_rate(ours: list[Row], other: list[Row], quantity: str = "psnr") -> float | None:
    """Return how many % more bytes `ours` takes for the same quality (Bjontegaard); None: the curves do not overlap."""
    curves: list[tuple[float, float, Callable[..., float]]] = []
    for rows in (ours, other):
        # the curve leaves out a file if a smaller file is better
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


def mean_bd_rate(rows: list[Row], ours: str, other: str) -> str:
    """Return the mean BD-rate over the images whose curves overlap."""
    rates = []
    for group in group_by(rows, ["image"]).values():
        first, second = ([row for row in group if row["method"] == method] for method in (ours, other))
        rate = bd_rate(first, second)
        rates += [] if rate is None else [rate]
    return (
        f"{abs(fmean(rates)):.0f} % {'fewer' if fmean(rates) < 0 else 'more'} bytes than" if rates else "no bytes like"
    )


def page(folder: Path, rows: list[Row]) -> Page:
    """Write the report."""
    rows = sorted(rows, key=lambda row: row["target_bytes"])
    equal = list(rows)
    for comparison in COMPARISONS:
        equal += at_equal_bits(rows, comparison, QUANTITIES, ["group"])
    comparisons = [Comparison(ours, f"{other}, equal bits") for ours, other in COMPARISONS]
    groups = {str(group): group_rows for (group,), group_rows in group_by(rows, ["group"]).items()}
    panels = [Panel(group, files, "bpp", name) for group, files in groups.items() for name in ("psnr", "ssimulacra2")]
    save_lines(folder / "rate.png", panels, "method", "target_bytes")
    group = "Kodak" if "Kodak" in groups else [*groups][-1]
    files = groups[group]
    webp, avif = (mean_bd_rate(files, PSNR, other) for other in ("WebP", AVIF_PSNR))
    size = sorted({row["target_bytes"] for row in files})[1]
    own = fmean(values_of((row for row in files if row["method"] == PSNR and row["target_bytes"] == size), "psnr"))
    eye = Comparison(EYE, "AVIF, equal bits")
    in_group = [row for row in equal if row["group"] == group]
    answer = (
        f"Files of kcgs for PSNR, without regions, have {own:.2f} dB in {size:,} bytes on {group}. For the same PSNR "
        f"they need {webp} WebP and {avif} AVIF tuned for PSNR. Against AVIF with as many bytes, the "
        f"SSIMULACRA2 of files for the eye is {mean_gain(in_group, eye, 'ssimulacra2', CASES):+.1f}, and better in "
        f"{count_wins(in_group, eye, 'ssimulacra2', CASES)} files. What viewers prefer is in the report of `pairs`."
    )
    printed = [
        {"group": "Kodak, as printed", "method": method, "target_bytes": size, "psnr": psnr}
        for method, curve in PRINTED.items()
        if "Kodak" in groups
        for size, psnr in zip(BYTES, curve, strict=False)
    ]
    fitting = [row for rows in groups.values() for row in rows if row["bytes"] <= row["target_bytes"]]
    table = means_table([*fitting, *printed], ["group", "method"], "target_bytes", ("psnr", "ssimulacra2"))
    losses = losses_table(equal, comparisons, ("psnr", "ef_psnr", "ssimulacra2"), CASES)
    gains = differences(equal, comparisons, QUANTITIES, CASES)
    return Page(answer, "rate.png", table, losses, METHOD, gains)
