"""What do regions gain with the same number of Gaussians, in the same time?"""

from __future__ import annotations

from pathlib import Path

from .core.compare import Comparison, at_equal_bits, count_wins, differences, losses_table, mean_gain
from .core.figures import Panel, save_lines
from .core.fits import METHODS, QUICK_ITERATIONS, fit_for, measure_result, method_of, timed_fit
from .core.images import PHOTOS, load_mapped, names
from .core.run import Job, Options, Page, Row
from .core.tables import group_by, join_tables, means_table

PUBLISHED = [*METHODS][2:]
COUNTS = {"DAVIS": (500, 1_250, 2_500, 5_000, 7_500, 10_000), "Kodak": (1_250, 10_000), "photos": (500, 1_250)}
QUANTITIES = ("psnr", "ef_psnr")
DECODED = ("decoded_psnr", "decoded_ef_psnr")
CASES = ["group", "n"]
PAIR = Comparison("best", "best-baseline")
EQUAL_BITS = Comparison("best", "best-baseline, equal bits")
COMPARISONS = (PAIR, *(Comparison("best", other) for other in PUBLISHED))
METHOD = """First frames of DAVIS with the given masks, photos of Kodak with the maps that `segment` finds. All
methods run as long as `best` takes for its 700 iterations, on one core: two short fits of each tell how many iterations
that are, and schedules are shortened by the recipes' own rule. `best-baseline` is `best` without regions;
`gaussian-image` is the paper's baseline, with `clamp` as published; `image-gs, L1 alone` is Image-GS as a plain sum,
where the publication takes a weighted mean of ten Gaussians, and without the SSIM loss, with which it would have a
tenth of the iterations. Table: PSNR / EF-PSNR in dB; EF-PSNR is within 5 pixels of the contours of the map that was
given. At equal bits, decoded files are compared with the baseline's at as many bytes, map included, interpolated
between its own files of that image."""


def measure(image: str, group: str, n: int, data: str, quick: bool) -> list[Row]:
    """Fit by the first method, then by the other methods in the same time."""
    pixels, labels = load_mapped(image, data, quick)
    rows: list[Row] = []
    for method in METHODS:
        if rows and not quick:
            result, seconds = fit_for(rows[0]["core_seconds"], pixels, labels, n, method)
        else:
            length = QUICK_ITERATIONS if quick else None
            result, seconds = timed_fit(pixels, labels, n, method_of(method, length))
        row = {"image": image, "group": group, "n": n, "method": method}
        rows.append(row | measure_result(result, seconds, pixels, labels))
    return rows


def jobs(options: Options) -> list[Job]:
    """List the images of each group; without data, photos of scikit-image."""
    arguments = options.image_arguments()
    if options.quick:
        return [{"image": "disc", "group": "disc", "n": n, **arguments} for n in (30, 60)]
    groups = {"photos": list(PHOTOS)}
    if options.data is not None:
        groups = {group: names(options.data, group.lower()) for group in ("DAVIS", "Kodak")}
    return [
        {"image": image, "group": group, "n": n, **arguments}
        for group, images in groups.items()
        for n in COUNTS[group]
        for image in images
    ]


def page(folder: Path, rows: list[Row]) -> Page:
    """Write the report."""
    rows = sorted(rows, key=lambda row: row["n"])
    equal = [*rows, *at_equal_bits(rows, PAIR, DECODED, ["group"])]
    gains = [*differences(rows, COMPARISONS, QUANTITIES, CASES), *differences(equal, [EQUAL_BITS], DECODED, CASES)]
    groups = group_by(rows, ["group"])
    panels = []
    for (group,), group_rows in groups.items():
        pair = [row for row in gains if row["group"] == group and row["method"] == " - ".join(PAIR)]
        panels += [Panel(str(group), group_rows, "n", "psnr"), Panel(f"{group}, 95 % intervals", pair, "n", "ef_psnr")]
    save_lines(folder / "quality.png", panels, "method", "n")
    first = next(iter(groups.values()))
    first_equal = [row for row in equal if row["group"] == first[0]["group"]]
    at_n = [mean_gain(first, PAIR, quantity, CASES) for quantity in QUANTITIES]
    at_bits = [mean_gain(first_equal, EQUAL_BITS, quantity, CASES) for quantity in DECODED]
    behind = {name: mean_gain(rows, Comparison("best", name), "psnr", CASES) for name in PUBLISHED}
    closest = min(behind, key=behind.__getitem__)
    answer = (
        f"With the same number of Gaussians and in the same time, regions change the PSNR by {at_n[0]:+.2f} dB and the "
        f"EF-PSNR by {at_n[1]:+.2f} dB on {first[0]['group']}, with the same bits by {at_bits[0]:+.2f} and "
        f"{at_bits[1]:+.2f} dB. Of the published methods `{closest}` comes closest: over all photos it is "
        f"{behind[closest]:.2f} dB behind `best`, which is better in "
        f"{count_wins(rows, Comparison('best', closest), 'psnr', CASES)} fits."
    )
    losses = losses_table(rows, COMPARISONS, QUANTITIES, CASES)
    losses_at_bits = losses_table(equal, [EQUAL_BITS], DECODED, CASES)
    table = means_table(rows, ["group", "method"], "n", QUANTITIES)
    return Page(answer, "quality.png", table, join_tables(losses, losses_at_bits), METHOD, gains)
