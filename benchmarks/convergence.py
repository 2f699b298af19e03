"""How small is the error after so many seconds?"""

from __future__ import annotations

from pathlib import Path
from statistics import fmean

from .core.compare import Comparison, differences, losses_table
from .core.figures import Panel, save_lines
from .core.fits import METHODS, QUICK_ITERATIONS, fit_for, measure_result, timed_fit
from .core.images import choose, load_mapped
from .core.run import RESULTS_FILE, Job, Options, Page, Row, read_rows
from .core.tables import group_by, means_table, values_of
from .gpu_fit import GPU

OTHERS = [*METHODS][1:]
PUBLISHED = OTHERS[1:]
NUM_GAUSSIANS = 1_250
REPORT_OF_GPU = Path(__file__).parent / "reports/gpu-fit" / RESULTS_FILE
BUDGETS = (2, 5, 15, 60)  # seconds of a core
QUANTITIES = ("psnr", "ef_psnr")
CASES = ["budget"]
COMPARISONS = tuple(Comparison("best", other) for other in OTHERS)
METHOD = f"""First frames of DAVIS with the given masks, N = {NUM_GAUSSIANS:,}. Each point is a fit of
its own on one core. `best` and `best-baseline` have `max_seconds`. The schedules of the published methods need a number
of iterations: two short fits tell how long an iteration takes. Compilation is not in the times. Table: PSNR / EF-PSNR
in dB."""
METHOD_OF_GPU = f""" `{GPU}` is a fit of 700 iterations, measured for the report of `gpu-fit`: its seconds are those of
the call on a GPU."""


def measure(image: str, method: str, n: int, data: str, quick: bool) -> list[Row]:
    """Fit an image once within each budget of seconds."""
    pixels, labels = load_mapped(image, data, quick)
    (recipe, settings), rows = METHODS[method], []
    for budget in BUDGETS:
        if method in PUBLISHED and not quick:
            result, seconds = fit_for(budget, pixels, labels, n, method)
        else:
            length = {"iterations": QUICK_ITERATIONS + budget} if quick else {"max_seconds": float(budget)}
            result, seconds = timed_fit(pixels, labels, n, (recipe, settings | length))
        row = {"image": image, "method": method, "budget": budget}
        rows.append(row | measure_result(result, seconds, pixels, labels))
    return rows


def jobs(options: Options) -> list[Job]:
    """List fits of frames of DAVIS; without data, of photos of scikit-image."""
    images = choose(options, "davis")
    n = 40 if options.quick else NUM_GAUSSIANS
    return [{"image": i, "method": m, "n": n, **options.image_arguments()} for i in images for m in METHODS]


def rows_of_gpu(images: set[str]) -> list[Row]:
    """Read the fits of these images on a GPU from the report of `gpu-fit`, if it has them."""
    rows = read_rows(REPORT_OF_GPU) if REPORT_OF_GPU.is_file() else []
    rows = [row for row in rows if row["image"] in images and (row["n"], row["method"]) == (NUM_GAUSSIANS, GPU)]
    return [{**row, "budget": 0, "core_seconds": row["seconds"]} for row in rows]


def page(folder: Path, rows: list[Row]) -> Page:
    """Write the report."""
    of_gpu = rows_of_gpu({row["image"] for row in rows})
    panels = [Panel("", rows + of_gpu, "core_seconds", quantity) for quantity in QUANTITIES]
    save_lines(folder / "convergence.png", panels, "method", "budget")
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
    method = METHOD
    if of_gpu:
        method += METHOD_OF_GPU
        seconds, value = (fmean(values_of(of_gpu, quantity)) for quantity in ("seconds", "psnr"))
        answer += f" On a GPU `best` has {value:.2f} dB after {seconds:.1f} seconds (report of `gpu-fit`)."
    table = means_table(rows, ["method"], "budget", QUANTITIES)
    losses = losses_table(rows, COMPARISONS, QUANTITIES, CASES)
    gains = differences(rows, COMPARISONS, QUANTITIES, CASES)
    return Page(answer, "convergence.png", table, losses, method, gains)
