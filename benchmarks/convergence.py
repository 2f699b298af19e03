"""How small is the error after so many seconds?"""

from __future__ import annotations

from pathlib import Path
from statistics import fmean

from .core.compare import Comparison, differences, group_by, losses_table, means_table, values_of
from .core.figures import Panel, save_lines
from .core.fits import METHODS, QUICK_ITERATIONS, config_of, figures, fit_for, timed_fit
from .core.images import choose, load_mapped
from .core.run import Job, Options, Page, Row

OTHERS = [*METHODS][1:]
PUBLISHED = OTHERS[1:]
NUM_GAUSSIANS = 1_250
BUDGETS = (2, 5, 15, 60)  # seconds of a core
QUANTITIES = ("psnr", "ef_psnr")
CASES = ["budget"]
COMPARISONS = tuple(Comparison("best", other) for other in OTHERS)
METHOD = f"""First frames of DAVIS with the given masks, N = {NUM_GAUSSIANS:,}. Each point is a fit of its own, which
is planned for that time on one core: two short fits tell how long an iteration takes, and schedules are shortened by
the recipes' own rule. Compilation is not in the times. Table: PSNR / EF-PSNR in dB."""


def measure(image: str, method: str, n: int, data: str, quick: bool) -> list[Row]:
    """Fit in each budget."""
    pixels, labels = load_mapped(image, data, quick)
    rows = []
    for budget in BUDGETS:
        if quick:
            result, seconds = timed_fit(pixels, labels, n, config_of(method, QUICK_ITERATIONS + budget))
        else:
            result, seconds = fit_for(budget, pixels, labels, n, method)
        row = {"image": image, "method": method, "budget": budget}
        rows.append(row | figures(result, seconds, pixels, labels))
    return rows


def jobs(options: Options) -> list[Job]:
    """Fit frames of DAVIS; without data, photos of scikit-image."""
    images = choose(options, "davis")
    n = 40 if options.quick else NUM_GAUSSIANS
    return [{"image": i, "method": m, "n": n, **options.image_arguments()} for i in images for m in METHODS]


def page(folder: Path, rows: list[Row]) -> Page:
    """Write the report."""
    save_lines(folder / "convergence.png", [Panel("", rows, "core_seconds", q) for q in QUANTITIES], "method", "budget")
    means = {
        (str(name), budget): fmean(values_of(group, "psnr"))
        for (name, budget), group in group_by(rows, ["method", "budget"]).items()
    }
    start, end = BUDGETS[0], BUDGETS[-1]
    closest = max(PUBLISHED, key=lambda name: means[name, end])
    first = max(METHODS, key=lambda name: means[name, start])
    ahead = [
        f"has more than that after {budget} seconds, and "
        for budget in BUDGETS
        if means["best", budget] > means[closest, end]
    ]
    answer = (
        f"After {end} seconds of a core the best published method, `{closest}`, has {means[closest, end]:.2f} dB PSNR. "
        f"`best` {''.join(ahead[:1])}has {means['best', end]:.2f} dB after {end}. After {start} seconds it has "
        f"{means['best', start]:.2f} dB, and `{first}`, the best by then, {means[first, start]:.2f} dB."
    )
    table = means_table(rows, ["method"], "budget", QUANTITIES)
    losses = losses_table(rows, COMPARISONS, QUANTITIES, CASES)
    gains = differences(rows, COMPARISONS, QUANTITIES, CASES)
    return Page(
        "How small is the error after so many seconds?", answer, "convergence.png", table, losses, METHOD, gains
    )
