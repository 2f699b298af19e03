"""What do contours gain at the same number of Gaussians, and at the same bits?"""

from __future__ import annotations

from pathlib import Path

from .core.compare import Contest, answer, at_equal_bits, differences, losses, means
from .core.figures import Panel, save_lines
from .core.fits import Method, measure_fit, plan
from .core.images import CHARTS, names
from .core.run import Job, Options, Page, Row, experiment

METHODS: dict[str, Method] = {
    name: (name, {})
    for name in ("best", "best-baseline", "paper", "gaussian-image", "gaussian-image-clamp", "image-gs")
}
CHART_METHODS: dict[str, Method] = {**METHODS, "paper, clamp": ("paper", {"clamp": True})}
CHART_COUNT, CHART_ITERATIONS = 20, 5_000
COUNTS = (500, 1_250, 2_500, 5_000, 7_500, 10_000)
# of the baseline alone: its files reach the bytes of the largest of `best`
MORE = 12_500
QUANTITIES = ("psnr", "ef_psnr")
DECODED = ("decoded_psnr", "decoded_ef_psnr")
PAIR = Contest("best", "best-baseline")
CONTESTS = (
    PAIR,
    *(Contest("best", other) for other in ("paper", "gaussian-image")),
    Contest("paper", "gaussian-image"),
)
METHOD = """Colour charts of 20 Gaussians, and first frames of DAVIS with the given masks. `best-baseline` is `best`
without regions, `paper` the paper's recipe, `gaussian-image` its baseline, with `clamp` as published. Published
recipes run shorter than they were published; the iterations are in the tables. PSNR and MS-SSIM are over the whole
image, EF-PSNR is within 5 pixels of the contours of the given map. Bytes are those of the `.kcgs` file, label map
included. *Equal bits* compares decoded files with the other's at as many bytes, interpolated between its own of that
image. Differences are paired by image; intervals are bootstrapped over images."""


def jobs(options: Options) -> list[Job]:
    """List the fits, the charts first."""
    if options.quick:
        return plan(["disc"], (30, 60), {name: METHODS[name] for name in PAIR}, options)
    fits = plan(CHARTS, (CHART_COUNT,), CHART_METHODS, options, CHART_ITERATIONS)
    if options.data is not None:
        frames = options.only or names(options.data, "davis")
        fits += plan([frame for frame in frames if frame not in CHARTS], COUNTS, METHODS, options)
        fits += plan(frames, (MORE,), {PAIR.other: METHODS[PAIR.other]}, options)
    return fits


def run(options: Options) -> None:
    """Measure, and write the report."""
    experiment(__name__, options, jobs, measure_fit, page)


def page(folder: Path, rows: list[Row]) -> Page:
    """Write the report."""
    frames = [row for row in rows if row["image"] not in CHARTS] or rows
    charts = [row for row in rows if row["image"] in CHARTS]
    counts = {row["n"] for row in frames if row["method"] == PAIR.ours}
    swept = sorted([row for row in frames if row["n"] in counts], key=lambda row: row["n"])
    equal = [*swept, *at_equal_bits(frames, PAIR, DECODED, ())]
    bits = Contest(PAIR.ours, f"{PAIR.other}, equal bits")
    panels = [Panel("", swept, "n", quantity) for quantity in ("psnr", "ef_psnr", "ms_ssim")]
    panels.append(Panel("", swept, "bpp", "decoded_psnr"))
    save_lines(folder / "quality.png", panels, "method", "n")
    columns = ("iterations", "psnr", "ms_ssim", "ef_psnr", "ssimulacra2", "bpp", "decoded_psnr", "core_seconds")
    tables = [differences(swept, CONTESTS, QUANTITIES, ["n"]), differences(equal, [bits], DECODED, ["n"])]
    tables += [means(swept, ["n", "method"], columns)]
    tables += [means(charts, ["image", "n", "method"], columns)] if charts else []
    sentences = answer(swept, PAIR, QUANTITIES, ["n"]), answer(equal, bits, DECODED, ["n"])
    lost = losses([*charts, *swept], CONTESTS, QUANTITIES, ["n"]), losses(equal, [bits], DECODED, ["n"])
    question = "What do contours gain at the same number of Gaussians, and at the same bits?"
    return Page(question, METHOD, " ".join(sentences), "quality.png", tables, "\n\n".join(filter(None, lost)))
