"""How small is the error after so many seconds?"""

from __future__ import annotations

from pathlib import Path
from statistics import fmean

from .core.compare import Comparison, differences, group_by, losses_table, mean_gain, means_table, values_of
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
    shortest, longest = ([row for row in rows if row["budget"] == budget] for budget in (BUDGETS[0], BUDGETS[-1]))
    ends = {name: mean_gain(longest, Comparison("best", name), "psnr") for name in PUBLISHED}
    closest = min(ends, key=ends.__getitem__)
    means = {str(name): fmean(values_of(group, "psnr")) for (name,), group in group_by(shortest, ["method"]).items()}
    first = max(means, key=means.__getitem__)
    answer = (
        f"After {BUDGETS[-1]} seconds of a core `best` has {ends[closest]:+.2f} dB PSNR against the closest published "
        f"method, `{closest}`. After {BUDGETS[0]} seconds `best` has {means['best']:.2f} dB, and `{first}`, the best "
        f"by then, {means[first]:.2f} dB."
    )
    table = means_table(rows, ["method"], "budget", QUANTITIES)
    losses = losses_table(rows, COMPARISONS, QUANTITIES, CASES)
    gains = differences(rows, COMPARISONS, QUANTITIES, CASES)
    return Page(
        "How small is the error after so many seconds?", answer, "convergence.png", table, losses, METHOD, gains
    )
