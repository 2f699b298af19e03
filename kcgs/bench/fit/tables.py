"""Tables in Markdown."""

from __future__ import annotations

import math
import statistics
from itertools import product

from kcgs.bench.cells import count, db, markdown, seconds, signed

from .cases import BASELINE, BEST, LIMITED, PAPER, SHORT
from .compare import TIE, Pair, Runs, Spread, mean, seconds_to_pass, spread, winner
from .runs import Run

# PSNR at 1,000 iterations of the prototype that the recipe was found with
PROTOTYPE = {
    "kodim02": 37.20,
    "kodim03": 40.81,
    "kodim06": 32.43,
    "kodim07": 40.40,
    "kodim09": 39.53,
    "kodim11": 34.44,
    "kodim12": 38.15,
    "kodim15": 37.35,
}
# GaussianImage's own mean over 24 Kodak images: PSNR, MS-SSIM, seconds
THEIRS = (32.05, 0.9797, 29.9)


def summary(runs: Runs, group: str) -> str:
    """Means of every recipe, and differences to the baseline of as many Gaussians."""
    header = ["N", "recipe", "images", "PSNR", "EF-PSNR", "s, median", "map bytes", "PSNR, difference", "won-lost"]
    header += ["worst", "EF-PSNR, difference", "won-lost", "worst"]
    lines = []
    for n in runs.counts(group):
        for name in runs.names(group):
            found = runs.of(group, name, n)
            if not found:
                continue
            line = [count(n), name, str(len(found)), db(mean(r.psnr for r in found))]
            line += [db(mean(r.ef_psnr for r in found)), seconds(statistics.median(r.seconds for r in found))]
            line.append(count(mean(r.map_bytes for r in found)))
            pairs = [] if name == BASELINE else runs.pairs(group, n, name)
            for quantity in ("psnr", "ef_psnr"):
                line += _spread_cells(spread(pairs, quantity))
            lines.append(line)
    return markdown(header, lines)


def at_equal_bytes(runs: Runs, group: str) -> str:
    """Every recipe beside the baseline with the Gaussians that its bytes buy."""
    header = ["N", "recipe", "images", "bytes, mean", "baseline's N, mean", "PSNR, difference", "won-lost", "worst"]
    header += ["EF-PSNR, difference", "won-lost", "worst", "ahead in PSNR", "ahead in EF-PSNR"]
    lines = []
    for n in runs.counts(group):
        for name in runs.rivals(group):
            pairs = runs.pairs(group, n, name, equal_bytes=True)
            if not pairs:
                continue
            line = [count(n), name, str(len(pairs)), count(mean(p.ours.bytes for p in pairs))]
            line.append(count(mean(p.baseline.n for p in pairs)))
            spreads = [spread(pairs, quantity) for quantity in ("psnr", "ef_psnr")]
            line += [cell for found in spreads for cell in _spread_cells(found)]
            line += ["" if found is None else winner(found.mean, name) for found in spreads]
            lines.append(line)
    return markdown(header, lines)


def each_image(runs: Runs, group: str, n: int) -> str:
    """All fits with N Gaussians, one a line."""
    header = ["image", "recipe", "PSNR", "EF-PSNR", "s", "given map, bytes", "stored map, bytes", "PSNR, difference"]
    header += ["EF-PSNR, difference", "baseline's N at equal bytes", "PSNR, difference", "EF-PSNR, difference", "ahead"]
    lines = []
    for image in dict.fromkeys(r.image for r in runs.of(group, n=n)):
        for name in runs.names(group):
            found = runs.find(group, image, n, name)
            if found is None:
                continue
            line = [image, name, db(found.psnr), db(found.ef_psnr), seconds(found.seconds)]
            line += [count(found.given_bytes), count(found.map_bytes)]
            line += _difference_cells(_pair_of(runs, found, equal_bytes=False))
            line += _equal_bytes_cells(_pair_of(runs, found, equal_bytes=True))
            lines.append(line)
    return markdown(header, lines)


def losses(runs: Runs, group: str) -> str:
    """Say for every recipe and N on which images it is below the baseline."""
    lines = []
    for equal_bytes, n, name in product((False, True), runs.counts(group), runs.rivals(group)):
        pairs = runs.pairs(group, n, name, equal_bytes=equal_bytes)
        for quantity, shown in (("psnr", "PSNR"), ("ef_psnr", "EF-PSNR")):
            below = sorted((getattr(p, quantity), p.ours.image) for p in pairs if getattr(p, quantity) < -TIE)
            if below:
                at = "equal bytes" if equal_bytes else "equal N"
                which = ", ".join(f"{image} {signed(value)}" for value, image in below)
                lines.append(f"- {at}, N = {n:,}, {name}, {shown}: {len(below)} of {len(pairs)}: {which}")
    return "\n".join(lines) or "Nowhere."


def against_paper(runs: Runs) -> str:
    """The paper's recipe, and the share of its time after which ours passes its result."""
    header = ["image", "N", "recipe", "iterations", "PSNR", "EF-PSNR", "s", "s to pass paper", "share of paper's time"]
    lines = []
    for paper in runs.of("paper", PAPER):
        lines.append([paper.image, count(paper.n), PAPER, *_fit_cells(paper), "", ""])
        for name in (BASELINE, BEST):
            found = runs.find("paper", paper.image, paper.n, name)
            if found is not None:
                passed = seconds_to_pass(found, paper.psnr)
                share = "never" if math.isnan(passed) else f"{100 * passed / paper.seconds:.2g} %"
                lines.append([paper.image, count(paper.n), name, *_fit_cells(found), seconds(passed), share])
    return markdown(header, lines)


def under_a_limit(runs: Runs) -> str:
    """What a limit on seconds costs."""
    header = ["image", "N", "default, s", "PSNR", "EF-PSNR", "3 s asked: s used", "iterations", "PSNR, difference"]
    header += ["EF-PSNR, difference"]
    lines, pairs = [], []
    for limited in runs.of("time", LIMITED):
        full = runs.find("time", limited.image, limited.n, BEST)
        if full is not None:
            pairs.append(Pair(limited, full))
            line = [limited.image, count(limited.n), seconds(full.seconds), db(full.psnr), db(full.ef_psnr)]
            line += [f"{limited.seconds:.2f}", count(limited.iterations), *_difference_cells(pairs[-1])]
            lines.append(line)
    means = [mean(getattr(p, quantity) for p in pairs) for quantity in ("psnr", "ef_psnr")]
    lines.append(["mean", *[""] * 6, *map(signed, means)])
    return markdown(header, lines)


def every_fit(runs: Runs, group: str) -> str:
    """All fits of a small group."""
    header = ["image", "N", "recipe", "iterations", "PSNR", "EF-PSNR", "s", "stored map, bytes"]
    order = sorted(runs.of(group), key=lambda r: r.image)
    return markdown(header, ([r.image, count(r.n), r.name, *_fit_cells(r), count(r.map_bytes)] for r in order))


def kodak(runs: Runs) -> str:
    """Kodak beside what was published and what the prototype had."""
    names = (SHORT, BASELINE)
    header = ["image"]
    for title in ("1,000 iterations", "default"):
        header += [f"{title}: PSNR", "MS-SSIM", "s"]
    header += ["prototype, 1,000 iterations: PSNR", "difference"]
    images = list(dict.fromkeys(r.image for r in runs.of("kodak")))
    lines = []
    for image in images:
        found = [next((r for r in runs.of("kodak", name) if r.image == image), None) for name in names]
        line = [image, *(cell for run in found for cell in _quality_cells([] if run is None else [run]))]
        then = PROTOTYPE.get(image, math.nan)
        now = math.nan if found[0] is None else found[0].psnr
        lines.append([*line, db(then), signed(now - then)])
    known = [r for r in runs.of("kodak", SHORT) if r.image in PROTOTYPE]
    line = ["mean", *(cell for name in names for cell in _quality_cells(runs.of("kodak", name)))]
    changes = mean(r.psnr - PROTOTYPE[r.image] for r in known)
    lines.append([*line, db(mean(PROTOTYPE[r.image] for r in known)), signed(changes)])
    theirs = [db(THEIRS[0]), f"{THEIRS[1]:.4f}", seconds(THEIRS[2])]
    lines.append(["GaussianImage, theirs: 24 images", "", "", "", *theirs, "", ""])
    return markdown(header, lines)


def _pair_of(runs: Runs, run: Run, *, equal_bytes: bool) -> Pair | None:
    if run.name not in runs.rivals(run.group):
        return None
    pairs = runs.pairs(run.group, run.n, run.name, equal_bytes=equal_bytes)
    return next((p for p in pairs if p.ours is run), None)


def _fit_cells(run: Run) -> list[str]:
    return [count(run.iterations), db(run.psnr), db(run.ef_psnr), seconds(run.seconds)]


def _quality_cells(found: list[Run]) -> list[str]:
    ms_ssim = mean(r.ms_ssim for r in found)
    shown = "" if math.isnan(ms_ssim) else f"{ms_ssim:.4f}"
    return [db(mean(r.psnr for r in found)), shown, seconds(mean(r.seconds for r in found))]


def _difference_cells(pair: Pair | None) -> list[str]:
    return ["", ""] if pair is None else [signed(pair.psnr), signed(pair.ef_psnr)]


def _equal_bytes_cells(pair: Pair | None) -> list[str]:
    if pair is None:
        return [""] * 4
    ahead = f"{winner(pair.psnr, pair.ours.name)} / {winner(pair.ef_psnr, pair.ours.name) or 'no band'}"
    return [count(pair.baseline.n), *_difference_cells(pair), ahead]


def _spread_cells(found: Spread | None) -> list[str]:
    if found is None:
        return [""] * 3
    deviation = "" if math.isnan(found.deviation) else f" ± {found.deviation:.2f}"
    worst = f"{found.worst} {signed(found.lowest)}"
    return [f"{signed(found.mean)}{deviation}", f"{found.wins}-{found.losses}", worst]
