"""Does the paper's method do what the paper says, at its full length?"""

from __future__ import annotations

from pathlib import Path

from .core.compare import Comparison, count_wins, differences, losses_table, mean_gain
from .core.figures import Panel, save_lines
from .core.fits import Method, measure_fit, plan
from .core.images import CHARTS, FRAMES
from .core.run import Job, Options, Page, Row
from .core.tables import group_by, means_table

METHODS: dict[str, Method] = {
    name: (name, {}) for name in ("best", "best-baseline", "paper", "gaussian-image", "gaussian-image-clamp")
}
CHART_METHODS: dict[str, Method] = {**METHODS, "paper, clamp": ("paper", {"clamp": True})}
CHART_COUNT = 20
COUNT = 1_250
# means that the paper prints over all of DAVIS at this N: PSNR and EF-PSNR in dB
PRINTED = {"paper": (27.31, 23.41), "gaussian-image": (27.29, 22.92), "gaussian-image-clamp": (27.10, 22.73)}
QUANTITIES = ("psnr", "ef_psnr")
CLAIMS = (Comparison("paper", "gaussian-image"), Comparison("paper", "gaussian-image-clamp"))
COMPARISONS = (*CLAIMS, *(Comparison("best", name) for name in PRINTED))
OF_CHARTS = Comparison("best", "paper, clamp")
METHOD = f"""The paper's method and its baselines at their published length of 50,000 iterations, `best` at its own
of 700. Charts of {CHART_COUNT} Gaussians, and first frames of DAVIS with the given masks and N = {COUNT:,}. Table:
PSNR / EF-PSNR in dB. Figures *as printed* are those of the paper, over all of DAVIS; nobody measured them here."""

measure = measure_fit


def jobs(options: Options) -> list[Job]:
    """List the charts and three frames."""
    if options.quick:
        return plan(["disc"], (30,), METHODS, options)
    frames = [] if options.data is None else [*FRAMES[::2]]
    return [*plan(frames, (COUNT,), METHODS, options), *plan(CHARTS, (CHART_COUNT,), CHART_METHODS, options)]


def page(folder: Path, rows: list[Row]) -> Page:
    """Write the report."""
    frames = [row for row in rows if row["image"] not in CHARTS]
    photos = frames or rows
    save_lines(folder / "published.png", [Panel("", photos, "core_seconds", y) for y in QUANTITIES], "method", "method")
    claim, ours = CLAIMS[0], Comparison("best", "paper")
    claimed = [mean_gain(photos, claim, quantity) for quantity in QUANTITIES]
    as_printed = [*map(float.__sub__, *(PRINTED[name] for name in claim))]
    wins = [count_wins(photos, claim, quantity) for quantity in QUANTITIES]
    gained = [mean_gain(photos, ours, quantity) for quantity in QUANTITIES]
    by_method = group_by(photos, ["method"])
    seconds = [sum(row["core_seconds"] for row in by_method[name,]) for name in ours]
    answer = (
        f"At full length the paper's method has {claimed[0]:+.2f} dB PSNR and {claimed[1]:+.2f} dB EF-PSNR against its "
        f"baseline without regions, as printed {as_printed[0]:+.2f} and {as_printed[1]:+.2f} dB, and wins in {wins[0]} "
        f"and {wins[1]} images. `best` has {gained[0]:+.2f} and {gained[1]:+.2f} dB against the paper's method, in "
        f"1/{max(1, round(seconds[1] / seconds[0]))} of its time."
    )
    printed = [
        {"image": "DAVIS, as printed", "method": name, "psnr": psnr, "ef_psnr": ef_psnr}
        for name, (psnr, ef_psnr) in PRINTED.items()
    ]
    table = means_table([*rows, *printed], ["method"], "image", QUANTITIES)
    losses = losses_table(rows, [*COMPARISONS, OF_CHARTS], QUANTITIES, [])
    return Page(answer, "published.png", table, losses, METHOD, differences(photos, COMPARISONS, QUANTITIES, []))
