"""What label maps bring that are found in the image: `kcgs bench maps`."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from kcgs.codec import decode, encode
from kcgs.functional import ef_psnr
from kcgs.plots import COLORS, figure, save_figure
from kcgs.rate import quality_for

from .core.cases import BASELINE, QUICK_ITERATIONS, REFINED, Case
from .core.figures import MARKERS
from .core.jobs import check_made
from .core.options import Options
from .core.registry import experiment
from .core.report import Made, conclude
from .core.rows import read_rows, write_rows
from .core.statistics import Bound, Summary, bounds_table, summarize
from .core.store import Store
from .core.tables import count, db, markdown, seconds, signed

AUTO = "auto"
OTHERS = ("felzenszwalb", "slic", "watershed", "kmeans")
COUNTS = (400, 1_000)
# the other sources are compared at the first of the counts, on every so many of the images
OTHERS_STRIDE = 4
QUICK_COUNT, QUICK_STRIDE, QUICK_IMAGES = 60, 4, 2
# mean gains in PSNR and EF-PSNR that an automatic map must bring, by N
LEAST = {400: (0.4, 0.8), 1_000: (0.1, 0.3)}
# the loss in PSNR that no image may pass, and the difference in dB that is neither a win nor a loss
MOST_LOSS, TIE = 0.1, 0.005
_GAINS = {
    "gain": "PSNR",
    "ef_gain": "EF-PSNR",
    "equal_gain": "PSNR at equal bytes",
    "equal_ef_gain": "EF-PSNR at equal bytes",
}
_INTRODUCTION = """No map is given: each comes from the image itself, by `kcgs.segment.segment(image, source)` with
its default options, and the fit is that of `kcgs fit --regions auto --recipe best-refined`: contours may move freely.
The baseline is `best-baseline` with as many Gaussians. PSNR is over the whole image;
EF-PSNR within 5 pixels of the contours of the final map, the one that the scene stores: both renders are measured in
that same band. Gained is what the fit with the map has over the baseline, in dB. An image whose final map has no
contour has no band. Intervals are the bootstrap's, 95 %, of the mean over images sampled in pairs. Bytes are those of
the scene's `.kcgs` file, and the map's share of them. Seconds are wall time, compilation excluded, in summaries
medians; what else the machine did meanwhile slows them."""
_BYTES_TEXT = """Gains above are at equal numbers of Gaussians, and a map's bytes come on top. Here the baseline has
the Gaussians that the bytes of the scene's file buy, the map's included, and what both files decode to is compared.
Files are written by `kcgs.codec.encode(scene, quality=psnr + 14.5)`, without a look at the image."""


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

    @property
    def gain(self) -> float:
        """Difference in PSNR, above zero where the map helps."""
        return self.psnr - self.baseline_psnr

    @property
    def ef_gain(self) -> float:
        """Difference in EF-PSNR."""
        return self.ef_psnr - self.baseline_ef_psnr

    @property
    def equal_gain(self) -> float:
        """Difference in PSNR to the baseline of as many bytes, both decoded."""
        return self.decoded_psnr - self.equal_psnr

    @property
    def equal_ef_gain(self) -> float:
        """Difference in EF-PSNR to the baseline of as many bytes, both decoded."""
        return self.decoded_ef_psnr - self.equal_ef_psnr


def report(output: Path, made: Made) -> list[str]:
    """Write the report's parts."""
    results = read_rows(output / "results.csv", Result)
    automatic = [r for r in results if r.source == AUTO]
    parts = ["# Label maps found in the image", _INTRODUCTION]
    if not results:
        return parts
    parts += ["## Where a map does not help", failures(results)]
    if not made.quick:
        bounded = "What automatic maps (`auto`) are held to, over all images."
        parts += ["## Bounds", bounded, bounds_table(bounds(automatic))]
    _plot_gains(results, output / "gains.png")
    parts += ["## Automatic maps", summary(automatic), "![](gains.png)"]
    parts += ["### At equal bytes", _BYTES_TEXT, at_equal_bytes(automatic)]
    others = [r for r in results if r.source != AUTO]
    if others:
        images = list(dict.fromkeys(r.image for r in others))
        beside = [r for r in automatic if r.image in images and r.n == others[0].n]
        which = f"On {len(images)} of the images: {', '.join(images)}."
        parts += ["## Other sources", which, summary([*beside, *others])]
    for n in sorted({r.n for r in automatic}):
        parts += [f"## Each image: auto, N = {n:,}", each_image([r for r in automatic if r.n == n])]
    if others:
        parts += [f"## Each image: other sources, N = {others[0].n:,}", each_image(others)]
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
        write_rows(output / "results.csv", Result, results, list(_GAINS))
        lacking = f"Stopped before its end: {len(results)} of {len(wanted)} fits with a map are there."
        conclude(report, output, options.made("maps", [lacking] if len(results) < len(wanted) else []))
    check_made(failed)


def images_of(data: Path | None) -> list[str]:
    """List the images; without data scikit-image's photo is all there is.

    Raises:
        ValueError: there are no images in the data.
    """
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
        image=case.image,
        n=case.n,
        source=case.source,
        given_regions=kept.given_regions,
        regions=1 if regions is None else regions.num_regions,
        bytes=row.bytes,
        map_bytes=row.map_bytes,
        psnr=row.psnr,
        ef_psnr=edges(case),
        baseline_psnr=alone.psnr,
        baseline_ef_psnr=edges(baseline(case)),
        segment_seconds=kept.segment_seconds,
        seconds=row.seconds,
        baseline_seconds=alone.seconds,
        decoded_psnr=row.decoded_psnr,
        decoded_ef_psnr=edges(case, decoded=True),
    )
    rival = equal_bytes(store, case)
    equal = None if rival is None else store.row(rival)
    if rival is None or equal is None:
        return result
    figures: dict[str, Any] = {"equal_psnr": equal.decoded_psnr, "equal_ef_psnr": edges(rival, decoded=True)}
    return result._replace(equal_n=rival.n, equal_bytes=equal.bytes, **figures)


def gain_of(results: Iterable[Result], quantity: str) -> Summary | None:
    """Sum up a gain of results, by name; images where it is not defined are left out. None: it is nowhere."""
    return summarize({r.image: float(getattr(r, quantity)) for r in results}, TIE)


def bounds(results: Sequence[Result]) -> list[Bound]:
    """Hold the automatic maps to the bounds of every N that was run."""
    found = []
    for n, least in LEAST.items():
        for quantity, bound in zip(("gain", "ef_gain"), least, strict=True):
            gain = gain_of([r for r in results if r.n == n], quantity)
            if gain is not None:
                measured = {f"mean {_GAINS[quantity]} gained": (bound, gain.mean)}
                if quantity == "gain":
                    what = f"PSNR gained on the worst image ({gain.worst[0]})"
                    measured[what] = -MOST_LOSS, gain.values[gain.worst[0]]
                for what, (limit, value) in measured.items():
                    shown = f">= {signed(limit)} dB", f"{signed(value)} dB"
                    found.append(Bound(f"N = {n:,}: {what}", *shown, value >= limit))
    return found


def failures(results: Sequence[Result]) -> str:
    """Name the images on which a source loses, worst first, and those whose map has no contour left."""
    lines = []
    for n, source in dict.fromkeys((r.n, r.source) for r in results):
        found = [r for r in results if (r.n, r.source) == (n, source)]
        for quantity, shown in _GAINS.items():
            gain = gain_of(found, quantity)
            if gain is not None and gain.losses:
                which = ", ".join(f"{image} {signed(gain.values[image])}" for image in gain.worst[: gain.losses])
                lines.append(f"- {source}, N = {n:,}, {shown}: {gain.losses} of {len(found)} images lose: {which}")
        bare = [r.image for r in found if r.regions == 1]
        if bare:
            lines.append(f"- {source}, N = {n:,}: no contour is left on {', '.join(bare)}")
    return "\n".join(lines) or "Nowhere."


def summary(results: Sequence[Result]) -> str:
    """Means of every source at every N, gains with their intervals."""
    header = ["N", "source", "images", "regions", "map bytes", "PSNR gained", "95 %", "won-lost", "worst"]
    header += ["EF-PSNR gained", "95 %", "won-lost", "worst", "s, map", "s, fit", "s, baseline"]
    lines = []
    for n, source in dict.fromkeys((r.n, r.source) for r in results):
        found = [r for r in results if (r.n, r.source) == (n, source)]
        line = [count(n), source, str(len(found)), f"{statistics.fmean(r.regions for r in found):.1f}"]
        line.append(count(statistics.fmean(r.map_bytes for r in found)))
        line += [*_gain_cells(gain_of(found, "gain")), *_gain_cells(gain_of(found, "ef_gain"))]
        for field in ("segment_seconds", "seconds", "baseline_seconds"):
            line.append(seconds(statistics.median(getattr(r, field) for r in found)))
        lines.append(line)
    return markdown(header, lines)


def at_equal_bytes(automatic: Sequence[Result]) -> str:
    """Gains over the baseline of as many bytes."""
    header = ["N", "source", "images", "bytes", "of these map", "baseline's N", "its bytes"]
    header += ["PSNR gained", "95 %", "won-lost", "worst", "EF-PSNR gained", "95 %", "won-lost", "worst"]
    lines = []
    for n in sorted({r.n for r in automatic if r.equal_n}):
        found = [r for r in automatic if r.n == n and r.equal_n]
        line = [count(n), AUTO, str(len(found))]
        fields = ("bytes", "map_bytes", "equal_n", "equal_bytes")
        line += [count(statistics.fmean(getattr(r, field) for r in found)) for field in fields]
        lines.append([*line, *(c for q in ("equal_gain", "equal_ef_gain") for c in _gain_cells(gain_of(found, q)))])
    return markdown(header, lines)


def each_image(results: Sequence[Result]) -> str:
    """One line per fit; where a map loses comes first."""
    header = ["image", "source", "regions found", "regions kept", "bytes", "map bytes", "PSNR", "baseline", "gained"]
    header += ["EF-PSNR", "baseline", "gained", "s, map", "s, fit", "s, baseline"]
    has_rivals = any(r.equal_n for r in results)
    header += ["baseline's N at equal bytes", "PSNR gained", "EF-PSNR gained"] if has_rivals else []
    lines = []
    for r in sorted(results, key=lambda r: (r.gain >= -TIE, r.gain if r.gain < -TIE else 0.0)):
        line = [r.image, r.source, count(r.given_regions), count(r.regions), count(r.bytes), count(r.map_bytes)]
        line += [db(r.psnr), db(r.baseline_psnr), signed(r.gain)]
        line += [db(r.ef_psnr), db(r.baseline_ef_psnr), signed(r.ef_gain)]
        line += map(seconds, (r.segment_seconds, r.seconds, r.baseline_seconds))
        line += [count(r.equal_n), signed(r.equal_gain), signed(r.equal_ef_gain)] if has_rivals else []
        lines.append(line)
    return markdown(header, lines)


def _gain_cells(gain: Summary | None) -> list[str]:
    if gain is None:
        return [""] * 4
    spread, worst = f"{signed(gain.low)} to {signed(gain.high)}", gain.worst[0]
    return [signed(gain.mean), spread, f"{gain.wins}-{gain.losses}", f"{worst} {signed(gain.values[worst])}"]


def _plot_gains(results: Sequence[Result], path: Path) -> None:
    """Plot the gain in PSNR against the bytes of the map, a dot per image, a panel for each N."""
    counts = sorted({r.n for r in results})
    plot, axes = figure(1, len(counts), width=1.0 + 4.6 * len(counts), height=4.4)
    for axis, n in zip(axes if len(counts) > 1 else [axes], counts, strict=True):
        axis.axhline(0.0, color="black", linewidth=0.8)
        axis.axhline(-MOST_LOSS, color="black", linewidth=0.8, linestyle=":", label="most that an image may lose")
        for index, source in enumerate((AUTO, *OTHERS)):
            points = [(r.map_bytes, r.gain) for r in results if (r.n, r.source) == (n, source)]
            if points:
                size = 6 if source == AUTO else 5
                style = {"color": COLORS[index], "markersize": size, "markeredgecolor": "white"}
                axis.plot(*zip(*points, strict=True), MARKERS[index], markeredgewidth=0.5, label=source, **style)
        axis.set(xlabel="bytes of the final map", ylabel="PSNR gained (dB)", title=f"N = {n:,}")
        axis.set_xlim(left=0)
        axis.legend(fontsize=7)
    save_figure(plot, path)
