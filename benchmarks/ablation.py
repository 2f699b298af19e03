"""What does each part of the paper's method, and of ours, gain?"""

from __future__ import annotations

from pathlib import Path

from .core.compare import Comparison, differences_table, group_by, losses_table, means_table, summary
from .core.figures import Panel, save_lines
from .core.fits import Method, measure_fit, plan
from .core.images import names
from .core.run import Job, Options, Page, Row

COUNTS = (1_250, 7_500)
PAPER_METHODS: dict[str, Method] = {
    "gaussian-image-clamp": ("gaussian-image-clamp", {}),
    "gaussian-image": ("gaussian-image", {}),
    "guidance, clamp": ("paper", {"warmup": False, "clamp": True}),
    "guidance + no clamp": ("paper", {"warmup": False}),
    "guidance + warm-up, clamp": ("paper", {"clamp": True}),
    "paper": ("paper", {}),
}
METHODS: dict[str, Method] = {
    "best": ("best", {}),
    "best with random start": ("best", {"initializer": "random"}),
    "best without densification": ("best", {"densify_from": 1.0}),
    "best without soft contours": ("best", {"softness": 0.0}),
    "best with L1 loss": ("best", {"loss": "l1"}),
    "best with contours as given": ("best", {"move_contours": False, "merge_regions": False}),
    "best-baseline": ("best-baseline", {}),
}
# what the paper prints over all of DAVIS at 50,000 iterations: PSNR and EF-PSNR by N
PRINTED = {
    "gaussian-image-clamp": {1_250: (27.10, 22.73), 7_500: (33.41, 30.33)},
    "gaussian-image": {1_250: (27.29, 22.92), 7_500: (33.57, 30.48)},
    "guidance, clamp": {1_250: (26.98, 22.72), 7_500: (33.25, 29.36)},
    "guidance + no clamp": {1_250: (27.15, 22.92), 7_500: (33.20, 29.31)},
    "guidance + warm-up, clamp": {1_250: (27.06, 23.09), 7_500: (33.28, 29.44)},
    "paper": {1_250: (27.31, 23.41), 7_500: (33.44, 29.18)},
}
QUANTITIES = ("psnr", "ef_psnr")
FIRST = next(iter(PAPER_METHODS))
COMPARISONS = (
    *(Comparison("best", name) for name in list(METHODS)[1:]),
    *(Comparison(name, FIRST) for name in list(PAPER_METHODS)[1:]),
)
METHOD = """First frames of DAVIS with the given masks. Parts of `best` are taken away one by one; the paper's six rows
differ from its clamped baseline. *Printed* figures are those of the paper, over all of DAVIS at 50,000 iterations;
nobody measured them here. What the figures are: the report of `quality`."""

measure = measure_fit


def jobs(options: Options) -> list[Job]:
    """Fit every row, all images at the smaller N first."""
    images = ["disc"] if options.quick else list(options.only) or names(options.folder(), "davis")
    methods = {**METHODS, **PAPER_METHODS}
    return [job for n in ((40,) if options.quick else COUNTS) for job in plan(images, (n,), methods, options)]


def page(folder: Path, rows: list[Row]) -> Page:
    """Write the report."""
    for row in rows:
        printed = PRINTED.get(row["method"], {}).get(row["n"])
        row |= dict(zip(("printed PSNR", "printed EF-PSNR"), printed, strict=True)) if printed else {}
    groups = group_by([row for row in rows if row["method"] in METHODS], ["n", "method"])
    # a mean of fewer images is no point of the figure
    ours = [row for (n, _), group in groups.items() if len(group) == len(groups[n, "best"]) for row in group]
    save_lines(folder / "ablation.png", [Panel("", ours, "n", quantity) for quantity in QUANTITIES], "method", "n")
    columns = ("iterations", *QUANTITIES, "printed PSNR", "printed EF-PSNR", "bytes", "core_seconds")
    tables = [differences_table(rows, COMPARISONS, QUANTITIES, ["n"]), means_table(rows, ["n", "method"], columns)]
    texts = [summary(rows, comparison, QUANTITIES, ["n"]) for comparison in COMPARISONS]
    sentences = "\n".join(f"- {text}" for text in texts if text)
    question = "What does each part of the method gain?"
    return Page(question, METHOD, sentences, "ablation.png", tables, losses_table(rows, COMPARISONS, QUANTITIES, ["n"]))
