"""From runs to a report with tables and figures."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from kcgs._atomic import atomic_path
from kcgs.bench.fits import HERE, Place
from kcgs.bench.machine import describe

from . import tables
from .cases import TIMED
from .compare import Runs
from .figures import plot_differences, plot_time
from .runs import Run

_INTRODUCTION = """Every recipe runs on the same kernel, from the same pictures, with seed 0. PSNR
and EF-PSNR are in dB; EF-PSNR is taken within 5 pixels of the contours of the map that was given, whichever map the
scene stores in the end. Seconds are wall time of the whole fit, compilation excluded. `best-baseline` is `best` with
the regions off; `best --keep-contours` draws with the map as given; in `best` contours may move a little, in
`best-refined` freely. Differences are to `best-baseline`, above zero where the recipe is better: mean, ± the standard
deviation over images, images won and lost by more than 0.005 dB, and the worst image."""
_BYTES_TEXT = """A Gaussian is counted as 7 bytes, the stored label map as lossless WebP, contour widths not at all. The
baseline gets the Gaussians that the bytes of the whole scene buy, the map's included."""
_GROUP_TEXTS = {
    "davis": "DAVIS, first frames, 480 x 854, the annotation as map.",
    "bsds": "BSDS500, about 321 x 481, one annotator's segments as map.",
    "astronaut": "scikit-image's photo, 512 x 512, the map from `kcgs.segment`.",
}
_PAPER_TEXT = """The paper's recipe at 20,000 iterations (it is written for 50,000) against ours at their defaults. The
share is that of the paper's wall time after which a fit first has the PSNR that the paper's recipe ends with."""
_TIME_TEXT = "The same fit with no more than 3 seconds of wall time; differences are to the default."
_CHARTS_TEXT = """Flat colours, 20 Gaussians. `best, sub-pixel coverage` is given 8 x 8 labels a pixel, the grid that
the pie's own edges were sampled on: exact contours, which no photo has. `gaussian-image` is the published baseline's
training without clamp, at its own length; our reading of it on our kernel."""
_KODAK_TEXT = """No regions, 9,000 Gaussians. GaussianImage's row is the mean that its authors published, theirs and not
measured here: over all 24 Kodak images, which are another set than ours, 50,000 iterations on an RTX 4090. The
prototype is the script that the recipe was found with; the mean of its column and of the differences is over the images
it has."""


def write(output: Path, made: Iterable[Run], notes: list[str], quick: bool, place: Place = HERE) -> None:
    """Write report.md and its figures into the folder.

    Args:
        output: folder.
        made: all that is there.
        notes: what was left out, a sentence each.
        quick: whether it is the short form.
        place: where fits that were missing were made.
    """
    runs = Runs(made)
    parts = ["# Fitting: quality, bytes, time", f"Made by `kcgs bench fit{' --quick' if quick else ''}`."]
    parts.append("\n".join(f"- {line}" for line in [*describe(), _where(place)]))
    if quick:
        parts.append("The short form, small pictures and few iterations: the numbers only show that all of it runs.")
    parts.append(_INTRODUCTION)
    if notes:
        parts += ["## Left out", "\n".join(f"- {note}" for note in notes)]
    parts += _time_figure(runs, output)
    for group, text in _GROUP_TEXTS.items():
        if runs.of(group):
            parts += _comparison(runs, group, text, output)
    others = (
        ("paper", "Against the paper's recipe", _PAPER_TEXT, tables.against_paper),
        ("time", "Under a limit of seconds", _TIME_TEXT, tables.under_a_limit),
        ("charts", "Colour charts", _CHARTS_TEXT, lambda found: tables.every_fit(found, "charts")),
        ("kodak", "Kodak", _KODAK_TEXT, tables.kodak),
    )
    for group, title, text, table in others:
        if runs.of(group):
            parts += [f"## {title}", text, table(runs)]
    with atomic_path(output / "report.md") as temporary:
        temporary.write_text("\n\n".join(parts) + "\n", encoding="utf-8")


def _where(place: Place) -> str:
    if place.is_here:
        return f"Fits: {place}"
    return f"Fits: {place}, but those of {' and '.join(TIMED)} {HERE}"


def _time_figure(runs: Runs, output: Path) -> list[str]:
    group = plot_time(runs, output / "error-against-time.png")
    if group is None:
        return []
    return ["## Error against time", f"The fits of the group {group}.", "![](error-against-time.png)"]


def _comparison(runs: Runs, group: str, text: str, output: Path) -> list[str]:
    parts = [f"## Against the baseline: {group}", text, "### Equal N", tables.summary(runs, group)]
    if plot_differences(runs, group, output / f"differences-{group}.png"):
        parts.append(f"![](differences-{group}.png)")
    parts += ["### Equal bytes", _BYTES_TEXT, tables.at_equal_bytes(runs, group)]
    parts += ["### Where a recipe is below the baseline", tables.losses(runs, group)]
    for n in runs.counts(group):
        parts += [f"### Each image, N = {n:,}", tables.each_image(runs, group, n)]
    return parts
