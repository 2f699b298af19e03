"""How soon has each recipe the quality that the paper's ends with?"""

from __future__ import annotations

import time
from pathlib import Path

from kcgs import fit
from kcgs.fitting import FitConfig, precompile

from .core.compare import Comparison, format_value, group_by, losses_table, markdown
from .core.figures import Panel, save_lines
from .core.fits import QUICK_ITERATIONS
from .core.images import load_mapped
from .core.run import Job, Options, Page, Row

METHODS = ("best", "best-baseline", "paper", "gaussian-image", "gaussian-image-clamp")
NUM_GAUSSIANS = 1_250
QUANTITIES = ("psnr", "ef_psnr")
COMPARISONS = tuple(Comparison("best", other) for other in METHODS[1:])
METHOD = """One image, every recipe at its published length. Seconds are those of the processor, on one thread: the
wall time in a fit's history times the share of a processor that the whole fit had. Compilation is not in them."""


def measure(image: str, recipe: str, n: int, data: str, quick: bool) -> list[Row]:
    """Return a fit's history."""
    pixels, labels = load_mapped(image, data, quick)
    config = FitConfig.from_recipe(recipe, **({"iterations": QUICK_ITERATIONS} if quick else {}))
    precompile(config)
    start, core_start = time.perf_counter(), time.process_time()
    result = fit(pixels, labels, n, recipe=config)
    share = (time.process_time() - core_start) / (time.perf_counter() - start)
    return [
        {"image": image, "method": recipe, "core_seconds": share * e.seconds, "iterations": e.iteration,
         "psnr": e.psnr, "ef_psnr": e.ef_psnr}
        for e in result.history
    ]  # fmt: skip


def jobs(options: Options) -> list[Job]:
    """Fit one image with every recipe: the first of `only`, or a photo of scikit-image."""
    image = "disc" if options.quick else (*options.only, "astronaut")[0]
    arguments = {"n": 40 if options.quick else NUM_GAUSSIANS, **options.image_arguments()}
    return [{"image": image, "recipe": m, **arguments} for m in METHODS]


def page(folder: Path, rows: list[Row]) -> Page:
    """Write the report."""
    histories = {str(method): history for (method,), history in group_by(rows, ["method"]).items()}
    ends = [history[-1] for history in histories.values()]
    header, lines = ["method", "iterations", "core s", "PSNR", "EF-PSNR"], []
    header += [f"s to the paper's {name}" for name in ("PSNR", "EF-PSNR")]
    for method, history in histories.items():
        end = history[-1]
        line = [method, *(format_value(name, end[name]) for name in ("iterations", "core_seconds", *QUANTITIES))]
        for quantity in QUANTITIES:
            goal = histories["paper"][-1].get(quantity, 0.0) if "paper" in histories else 0.0
            reached = [row["core_seconds"] for row in history if row.get(quantity, -1.0) >= goal]
            line.append(format_value("core_seconds", reached[0]) if reached else "never")
        lines.append(line)
    panels = [Panel("", [row for row in rows if row["core_seconds"] > 0], "core_seconds", q) for q in QUANTITIES]
    save_lines(folder / "convergence.png", panels, "method", "core_seconds", marker=False)
    by_method = dict(zip(histories, lines, strict=True))
    text = "On {}, `best` has the PSNR with which `paper` ends after {} s, `paper` after {} s."
    text = (
        text.format(rows[0]["image"], by_method["best"][5], by_method["paper"][2])
        if {"best", "paper"} <= {*by_method}
        else ""
    )
    losses = losses_table(ends, COMPARISONS, QUANTITIES, [])
    return Page("How soon is a fit good?", METHOD, text, "convergence.png", [markdown(header, lines)], losses)
