"""What label maps bring that are found in the image: `python -m benchmarks maps`."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from kcgs.codec import decode, encode
from kcgs.functional import ef_psnr
from kcgs.rate import quality_for

from .core.cases import BASELINE, QUICK_ITERATIONS, REFINED, Case
from .core.jobs import check_made
from .core.options import Options
from .core.registry import experiment
from .core.report import Made, conclude
from .core.rows import read_rows, write_rows
from .core.statistics import Summary, summarize
from .core.store import Store
from .core.tables import count, markdown, number, seconds, signed

AUTO = "auto"
OTHERS = ("felzenszwalb", "slic", "watershed", "kmeans")
COUNTS = (400, 1_000)
# the other sources are compared at the first of the counts, on every so many of the images
OTHERS_STRIDE = 4
QUICK_COUNT, QUICK_STRIDE, QUICK_IMAGES = 60, 4, 2
# the difference in dB that is neither a win nor a loss
TIE = 0.005
# what is gained, and the fields that it is the difference of
GAINS = {
    "PSNR": ("psnr", "baseline_psnr"),
    "EF-PSNR": ("ef_psnr", "baseline_ef_psnr"),
    "PSNR at equal bytes": ("decoded_psnr", "equal_psnr"),
    "EF-PSNR at equal bytes": ("decoded_ef_psnr", "equal_ef_psnr"),
}
_INTRODUCTION = """No map is given: each comes from the image itself, see docs/results.md. Gained is what the fit with
the map has over the baseline, in dB. An image whose final map has no contour has no band. Seconds are medians. Each
image by itself: results.csv."""


class Result(NamedTuple):
    """A fit with a map beside the baseline of as many Gaussians, both measured in the band of the final map."""

    image: str
    n: int
    source: str
    given_regions: int
    regions: int  # in the end
    bytes: int  # of the scene's file
    map_bytes: int  # of these the final map's; 0: it has no contour
    psnr: float
    ef_psnr: float  # naN: there is no contour
    baseline_psnr: float
    baseline_ef_psnr: float
    segment_seconds: float
    seconds: float  # of the fit
    baseline_seconds: float
    decoded_psnr: float = math.nan  # of the file
    decoded_ef_psnr: float = math.nan
    equal_n: int = 0  # of the baseline that the bytes of the file buy; 0: it was not asked for
    equal_bytes: int = 0  # of that baseline's file
    equal_psnr: float = math.nan  # decoded
    equal_ef_psnr: float = math.nan


def report(output: Path, made: Made) -> list[str]:
    """Write the report's parts."""
    results = read_rows(output / "results.csv", Result)
    automatic = [r for r in results if r.source == AUTO]
    parts = ["# Label maps found in the image", _INTRODUCTION]
    if not results:
        return parts
    parts += ["## Where a map does not help", failures(results)]
    parts += ["## Automatic maps", gains_table(automatic), sizes_table(automatic)]
    others = [r for r in results if r.source != AUTO]
    if others:
        images = list(dict.fromkeys(r.image for r in others))
        beside = [r for r in automatic if r.image in images and r.n == others[0].n]
        which = f"On {len(images)} of the images: {', '.join(images)}."
        parts += ["## Other sources", which, gains_table([*beside, *others]), sizes_table([*beside, *others])]
    return parts


@experiment("engine", "workers", "runs", report=report)
def run(output: Path, options: Options) -> None:
    """Fit with automatic maps and without; without data one photo is all there is.

    No fit's seconds are held against another's, so that they may run side by side; the report says where they ran.
    """
    wanted, store = plan(options.data, options.quick), Store.open(output, options)
    failed: list[str] = []
    try:
        # an image's baseline before its maps, so that what is there when somebody interrupts can be compared
        failed += store.obtain([c for case in wanted for c in (baseline(case), case)], options.place)
        rivals = [equal_bytes(store, case) for case in wanted]
        failed += store.obtain([rival for rival in rivals if rival is not None], options.place)
    finally:
        results = [found for case in wanted if (found := compare(store, case)) is not None]
        write_rows(output / "results.csv", Result, results)
        lacking = f"Stopped before its end: {len(results)} of {len(wanted)} fits with a map are there."
        conclude(report, output, options.made("maps", [lacking] if len(results) < len(wanted) else []))
    check_made(failed)


def images_of(data: Path | None) -> list[str]:
    """List the images; without data scikit-image's photo is all there is. A ValueError: there are none in the data."""
    if data is None:
        return ["astronaut"]
    found = sorted((p.parent.name for p in (data / "bsds").glob("*/image.jpg")), key=lambda name: (len(name), name))
    if not found:
        raise ValueError(f"data must have a folder bsds with NAME/image.jpg in it; got {str(data)!r}")
    return found


def plan(data: Path | None, quick: bool) -> list[Case]:
    """List the fits with a map; its contours may move freely."""
    images = images_of(data)
    counts, shown = ((QUICK_COUNT,), images[:QUICK_IMAGES]) if quick else (COUNTS, images)
    few = images[:1] if quick else images[::OTHERS_STRIDE]
    sources = [(n, image, AUTO) for n in counts for image in shown]
    sources += [(counts[0], image, source) for image in few for source in OTHERS]
    how: dict[str, Any] = {"iterations": QUICK_ITERATIONS, "stride": QUICK_STRIDE} if quick else {}
    return [Case(image, n, REFINED, source=source, **how) for n, image, source in sources]


def baseline(case: Case) -> Case:
    """Return the fit of the same image without a map."""
    return case._replace(method=BASELINE, source="none")


def equal_bytes(store: Store, case: Case) -> Case | None:
    """Return the baseline with the Gaussians that the bytes of a finished fit buy; None: it is not asked for."""
    ours, other = store.row(case), store.row(baseline(case))
    if case.source != AUTO or ours is None or other is None:
        return None
    return baseline(case)._replace(n=max(1, round(case.n * ours.bytes / other.bytes)))


def compare(store: Store, case: Case) -> Result | None:
    """Measure a fit beside its baselines; None: the fit, or the one of as many Gaussians, is not there."""
    kept, alone = store.kept(case), store.row(baseline(case))
    if kept is None or alone is None:
        return None
    row, image, regions = kept.row, case.load(store.data).image, store.scene(case).regions
    labels = None if regions is None or regions.num_regions == 1 else regions.labels

    def edges(shown: Case, decoded: bool = False) -> float:
        """Measure another case in this one's final band."""
        found, scene = store.row(shown), store.scene(shown)
        if labels is None or found is None:
            return math.nan
        scene = decode(encode(scene, quality=quality_for(found.psnr))).scene if decoded else scene
        return float(ef_psnr(scene.render(), image, labels))

    result = Result(
        image=case.image, n=case.n, source=case.source, given_regions=kept.given_regions,
        regions=1 if regions is None else regions.num_regions, bytes=row.bytes, map_bytes=row.map_bytes, psnr=row.psnr,
        ef_psnr=edges(case), baseline_psnr=alone.psnr, baseline_ef_psnr=edges(baseline(case)),
        segment_seconds=kept.segment_seconds, seconds=row.seconds, baseline_seconds=alone.seconds,
        decoded_psnr=row.decoded_psnr, decoded_ef_psnr=edges(case, decoded=True),
    )  # fmt: skip
    rival = equal_bytes(store, case)
    equal = None if rival is None else store.row(rival)
    if rival is None or equal is None:
        return result
    figures: dict[str, Any] = {"equal_psnr": equal.decoded_psnr, "equal_ef_psnr": edges(rival, decoded=True)}
    return result._replace(equal_n=rival.n, equal_bytes=equal.bytes, **figures)


def gain_of(results: Iterable[Result], quantity: str) -> Summary | None:
    """Sum up a gain of results, by name; images where it is not defined are left out. None: it is nowhere."""
    ours, other = GAINS[quantity]
    return summarize({r.image: float(getattr(r, ours) - getattr(r, other)) for r in results}, TIE)


def failures(results: Sequence[Result]) -> str:
    """Name the images on which a source loses, worst first, and those whose map has no contour left."""
    lines = []
    for (n, source), found in _groups(results).items():
        for quantity in GAINS:
            gain = gain_of(found, quantity)
            if gain is not None and gain.losses:
                which = ", ".join(f"{image} {signed(gain.values[image])}" for image in gain.worst[: gain.losses])
                lines.append(f"- {source}, N = {n:,}, {quantity}: {gain.losses} of {len(found)} images lose: {which}")
        bare = [r.image for r in found if r.regions == 1]
        if bare:
            lines.append(f"- {source}, N = {n:,}: no contour is left on {', '.join(bare)}")
    return "\n".join(lines) or "Nowhere."


def gains_table(results: Sequence[Result]) -> str:
    """Write mean gains with their intervals, a line for each N, source and quantity."""
    lines = []
    for (n, source), found in _groups(results).items():
        for quantity in GAINS:
            gain = gain_of(found, quantity)
            if gain is not None:
                spread, worst = f"{signed(gain.low)} to {signed(gain.high)}", gain.worst[0]
                line = [count(n), source, quantity, str(len(gain.values)), signed(gain.mean), spread]
                lines.append([*line, f"{gain.wins}-{gain.losses}", f"{worst} {signed(gain.values[worst])}"])
    return markdown(["N", "source", "gained in", "images", "mean", "95 %", "won-lost", "worst"], lines)


def sizes_table(results: Sequence[Result]) -> str:
    """Write mean sizes and median seconds of every source at every N."""
    sizes = {"regions": "regions", "bytes": "bytes", "of these map": "map_bytes", "N at equal bytes": "equal_n"}
    times = {"s, map": "segment_seconds", "s, fit": "seconds", "s, baseline": "baseline_seconds"}
    lines = []
    for (n, source), found in _groups(results).items():
        line = [count(n), source]
        line += [number(statistics.fmean(getattr(r, field) for r in found) or math.nan) for field in sizes.values()]
        lines.append(line + [seconds(statistics.median(getattr(r, field) for r in found)) for field in times.values()])
    return markdown(["N", "source", *sizes, *times], lines)


def _groups(results: Sequence[Result]) -> dict[tuple[int, str], list[Result]]:
    found: dict[tuple[int, str], list[Result]] = {}
    for result in results:
        found.setdefault((result.n, result.source), []).append(result)
    return found
