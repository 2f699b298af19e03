"""What do contours gain at the same number of Gaussians, and at the same bits?"""

from __future__ import annotations

from pathlib import Path

from .core.compare import Comparison, at_equal_bits, differences_table, losses_table, means_table, summary
from .core.figures import Panel, save_lines
from .core.fits import Method, measure_fit, plan
from .core.images import CHARTS, names
from .core.run import Job, Options, Page, Row

METHODS: dict[str, Method] = {
    name: (name, {})
    for name in ("best", "best-baseline", "paper", "gaussian-image", "gaussian-image-clamp", "image-gs")
}
CHART_METHODS: dict[str, Method] = {**METHODS, "paper, clamp": ("paper", {"clamp": True})}
CHART_COUNT = 20
CHART_ITERATIONS = 5_000
COUNTS = (500, 1_250, 2_500, 5_000, 7_500, 10_000)
# N of one more fit of the baseline, so that its files reach the bytes of the largest file of `best`
BASELINE_COUNT = 12_500
QUANTITIES = ("psnr", "ef_psnr")
DECODED = ("decoded_psnr", "decoded_ef_psnr")
PAIR = Comparison("best", "best-baseline")
COMPARISONS = (
    PAIR,
    *(Comparison("best", other) for other in ("paper", "gaussian-image")),
    Comparison("paper", "gaussian-image"),
)
METHOD = """Colour charts of 20 Gaussians, and first frames of DAVIS with the given masks. `best-baseline` is `best`
without regions, `paper` the paper's recipe, `gaussian-image` its baseline, with `clamp` as published. Published
recipes run shorter than they were published; the iterations are in the tables. PSNR and MS-SSIM are over the whole
image, EF-PSNR is within 5 pixels of the contours of the given map. Bytes are those of the `.kcgs` file, label map
included. *Equal bits* compares decoded files with the other's at as many bytes, interpolated between its own of that
image. Differences are paired by image; intervals are bootstrapped over images."""

measure = measure_fit


def jobs(options: Options) -> list[Job]:
    """List the fits, the charts first."""
    if options.quick:
        return plan(["disc"], (30, 60), {name: METHODS[name] for name in PAIR}, options)
    fits = plan(CHARTS, (CHART_COUNT,), CHART_METHODS, options, CHART_ITERATIONS)
    if options.data is not None:
        frames = options.only or names(options.data, "davis")
        fits += plan([frame for frame in frames if frame not in CHARTS], COUNTS, METHODS, options)
        fits += plan(frames, (BASELINE_COUNT,), {PAIR.second: METHODS[PAIR.second]}, options)
    return fits


def page(folder: Path, rows: list[Row]) -> Page:
    """Write the report."""
    frames = [row for row in rows if row["image"] not in CHARTS] or rows
    charts = [row for row in rows if row["image"] in CHARTS]
    counts = {row["n"] for row in frames if row["method"] == PAIR.first}
    at_counts = sorted([row for row in frames if row["n"] in counts], key=lambda row: row["n"])
    equal = [*at_counts, *at_equal_bits(frames, PAIR, DECODED, ())]
    bits = Comparison(PAIR.first, f"{PAIR.second}, equal bits")
    panels = [Panel("", at_counts, "n", quantity) for quantity in ("psnr", "ef_psnr", "ms_ssim")]
    panels.append(Panel("", at_counts, "bpp", "decoded_psnr"))
    save_lines(folder / "quality.png", panels, "method", "n")
    columns = ("iterations", "psnr", "ms_ssim", "ef_psnr", "ssimulacra2", "bpp", "decoded_psnr", "core_seconds")
    tables = [
        differences_table(at_counts, COMPARISONS, QUANTITIES, ["n"]),
        differences_table(equal, [bits], DECODED, ["n"]),
    ]
    tables += [means_table(at_counts, ["n", "method"], columns)]
    tables += [means_table(charts, ["image", "n", "method"], columns)] if charts else []
    sentences = summary(at_counts, PAIR, QUANTITIES, ["n"]), summary(equal, bits, DECODED, ["n"])
    losses = [losses_table([*charts, *at_counts], COMPARISONS, QUANTITIES, ["n"])]
    losses.append(losses_table(equal, [bits], DECODED, ["n"]))
    question = "What do contours gain at the same number of Gaussians, and at the same bits?"
    return Page(question, METHOD, " ".join(sentences), "quality.png", tables, "\n\n".join(filter(None, losses)))
