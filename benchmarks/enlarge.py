"""Scenes of small photos rendered large, beside enlargements of pixels: `python -m benchmarks enlarge`."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from kcgs.functional import ef_psnr, psnr
from kcgs.plots import COLORS, figure, save_figure

from .core import images, summaries
from .core.cases import BEST, QUICK_ITERATIONS, Case
from .core.clocks import clock, in_turns
from .core.compare import counts, equal_n, mean_over, select
from .core.figures import CROPS, MARKERS, add_legend, cut_crops, plot_images
from .core.jobs import check_made, with_progress
from .core.options import Options
from .core.registry import experiment
from .core.report import Made, conclude
from .core.rows import read_rows, write_rows
from .core.store import Row, Store, find_labels
from .core.tables import count, markdown, signed

# by the source of label maps: the group's name, and its images
GROUPS = {"given": ("DAVIS", images.FRAMES), "auto": ("Kodak", tuple(f"kodim{number:02}" for number in range(1, 25)))}
FACTORS = (4, 2)
# pixels of the small photo per Gaussian
SHARES, QUICK_SHARES = (330, 80, 25), (330,)
SCENE, OWN, PHOTO = "scene", "own render, bicubic", "small photo, bicubic"
METHODS = (SCENE, OWN, "own render, Lanczos", PHOTO, "small photo, Lanczos")
QUANTITIES = {"psnr": "PSNR", "ef_psnr": "EF-PSNR"}
# dB that an image may be behind; width of the band along contours in pixels of the small photo
MOST_LOSS, BAND = 0.1, 5
_ROUNDS, _CROPS, _COLUMNS = 5, 3, ("PSNR", "EF-PSNR", "s", "core s")
_INTRODUCTION = f"""Photos are reduced by area and fitted by `best`. `{SCENE}` is `scene.render(size)` at the original
size, `own render` the scene's render at the small size, enlarged, `small photo` all pixels of the reduced photo,
enlarged. They are measured against the original. DAVIS frames have the given map, reduced by majority; on Kodak the map
is found in the small photo. EF-PSNR is within {BAND} pixels of the small photo of the given contours, or of those found
in the original. Pillow enlarges floats, its bicubic has a = -0.5. Gained is what `{SCENE}` has over `{OWN}`: wanted are
means of at least 0, better +0.2, and no image below -{MOST_LOSS}. *s* is the wall time from the scene, or the small
photo, to the large image, *core s* the processor time of the fit and of finding its map, on one thread. In the figure
solid lines are with the fit, dashed ones without."""
_CROPS_TEXT = f"""The {_CROPS} images with the least gain in PSNR, where `{SCENE}` is furthest behind `{OWN}`; then
{_CROPS} next to the median, where it is furthest from the original. The PSNR is that of the crop."""


def report(output: Path, made: Made) -> list[str]:
    """Write the report's parts."""
    kinds: dict[str, list[Row]] = {}
    for row in read_rows(output / "results.csv", Row):
        kinds.setdefault(row.note, []).append(row)
    parts = ["# Scenes enlarged", _INTRODUCTION]
    if not kinds:
        return parts
    _plot(output / "error-against-time.png", kinds)
    parts += ["## Gained", gains_table(kinds), "## Error against time", "![](error-against-time.png)"]
    for kind, rows in kinds.items():
        images_of = ", ".join(dict.fromkeys(row.image for row in rows))
        parts += [f"## {kind}", f"Images: {images_of}.", summaries.means(rows, METHODS, _COLUMNS)]
    return parts + (["## Crops", _CROPS_TEXT, f"![]({CROPS})"] if (output / CROPS).is_file() else [])


@experiment("engine", "workers", "runs", report=report)
def run(output: Path, options: Options) -> None:
    """Fit small photos and measure all at the original size; fits that are there are not made again."""
    wanted, store = plan(options.data, options.quick), Store.open(output, options)
    try:
        failed = store.obtain(wanted, options.place)
    finally:
        present, rounds = [(str(c), c) for c in wanted if store.row(c) is not None], 1 if options.quick else _ROUNDS
        measured = {case: compare(store, case, rounds) for case in with_progress(present)}
        write_rows(output / "results.csv", Row, [row for rows in measured.values() for row in rows])
        crops = [crop for index, case in enumerate(chosen(measured)) for crop in _crop(store, case, index < _CROPS)]
        plot_images(output / CROPS, *crops) if crops else (output / CROPS).unlink(missing_ok=True)
        notes = [] if options.quick else missing(wanted)
        notes += [f"Stopped: {len(present)} of {len(wanted)} fits are there."] if len(present) < len(wanted) else []
        conclude(report, output, options.made("enlarge", notes))
    check_made(failed)


def plan(data: Path | None, quick: bool) -> list[Case]:
    """List the fits; a ValueError or FileNotFoundError: there is no DAVIS in the data."""
    names = {"given": ["disc"], "auto": ["astronaut"]}
    if data is not None or not quick:
        known = [*images.davis(data).sequences, *(path.stem for path in Path(data or "", "kodak").glob("*.png"))]
        names = {source: [name for name in group if name in known] for source, (_, group) in GROUPS.items()}
    cases = [
        Case(name, 0, BEST, source=source, factor=factor, iterations=QUICK_ITERATIONS if quick else None)
        for source, factor in product(names, FACTORS)
        for name in names[source][: 1 if quick else None]
    ]
    pixels = {case: case.load(data).image[0].numel() for case in cases}
    return [c._replace(n=round(pixels[c] / s)) for c, s in product(cases, QUICK_SHARES if quick else SHARES)]


def missing(wanted: Sequence[Case]) -> list[str]:
    """Say which images the data lacks."""
    groups = {group: sorted({*names} - {case.image for case in wanted}) for group, names in GROUPS.values()}
    return [f"{group}: {len(n)} images are not in the data: {', '.join(n)}." for group, n in groups.items() if n]


def enlarge(image: Tensor, size: tuple[int, int], how: str) -> Tensor:
    """Enlarge (C, H, W) to (height, width) by Pillow's `how`; in [0, 1], not rounded to 8 bits."""
    planes = [Image.fromarray(plane.numpy()).resize(size[::-1], Image.Resampling[how.upper()]) for plane in image]
    return torch.from_numpy(np.stack([np.asarray(plane) for plane in planes])).clamp(0, 1)


def views(store: Store, case: Case) -> tuple[images.Sample, dict[str, Callable[[], Tensor]]]:
    """Return the original, and what makes each method's image."""
    original, scene = _original(case.image, store.data, case.factor), store.scene(case)
    size = (original.image.shape[1], original.image.shape[2])
    steps: dict[str, Callable[[], Tensor]] = {SCENE: partial(scene.render, size)}
    for how in ("bicubic", "Lanczos"):
        steps[f"own render, {how}"] = partial(lambda how: enlarge(scene.render(), size, how), how)
        steps[f"small photo, {how}"] = partial(enlarge, case.load(store.data).image, size, how)
    return original, steps


def compare(store: Store, case: Case, rounds: int) -> list[Row]:
    """Measure every method's image beside the original, and time it so many times."""
    ((image, labels), steps), kept = views(store, case), store.kept(case)
    assert kept is not None
    shown = {name: step() for name, step in steps.items()}  # first calls are not timed
    times = in_turns({name: partial(clock, step) for name, step in steps.items()}, rounds)
    undefined = dict.fromkeys([name for name in Row._fields if name.endswith(("psnr", "ssim"))], math.nan)
    note, fit, rows = f"{GROUPS[case.source][0]}, {case.factor}x", kept.row.core_seconds + kept.segment_seconds, []
    for method in METHODS:
        figures = {**undefined, "psnr": float(psnr(shown[method], image))}
        if labels is not None and len(labels.unique()) > 1:
            figures["ef_psnr"] = float(ef_psnr(shown[method], image, labels, width=BAND * case.factor))
        figures["seconds"] = statistics.median(times[method])
        figures["core_seconds"] = math.nan if method.startswith("small") else fit
        rows.append(kept.row._replace(method=method, note=note, **figures))  # type: ignore[arg-type]
    return rows


def gains_table(kinds: Mapping[str, Sequence[Row]]) -> str:
    """Write what is gained, and which images are further behind than they may be, worst first."""
    lines = []
    for (kind, rows), (quantity, name) in product(kinds.items(), QUANTITIES.items()):
        for n in counts(rows, SCENE):
            if (gain := equal_n(rows, SCENE, OWN, n, quantity)) is not None:
                line = [kind, count(n), count(select(rows, SCENE, n)[0].pixels / n), name, str(len(gain.values))]
                line += [signed(gain.mean), f"{signed(gain.low)} to {signed(gain.high)}".strip(" to")]
                worst = [f"{image} {signed(gain.values[image])}" for image in gain.worst]
                behind = sum(value < -MOST_LOSS for value in gain.values.values())
                lines.append([*line, worst[0], f"{behind}: {', '.join(worst[:behind])}" if behind else "0"])
    header = ["images", "N", "pixels per Gaussian", "gained in", "number", "mean", "95 %", "worst"]
    return markdown([*header, f"below -{MOST_LOSS}"], lines)


def chosen(measured: Mapping[Case, Sequence[Row]]) -> list[Case]:
    """Choose the cases of the crops, each of another image: those that gain least, and those next to the median."""
    gain = {case: rows[0].psnr - rows[1].psnr for case, rows in measured.items()}
    middle = statistics.median(gain.values()) if gain else 0.0
    found: dict[str, Case] = {}
    for most, distance in ((_CROPS, gain), (2 * _CROPS, {case: abs(gain[case] - middle) for case in gain})):
        for case in sorted(distance, key=distance.__getitem__):
            if len(found) < most:
                found.setdefault(case.image, case)
    return list(found.values())


def _crop(store: Store, case: Case, is_worst: bool) -> list[dict[str, Tensor]]:
    (image, _), steps = views(store, case)
    shown = {"original": image, **{name: steps[name]() for name in (SCENE, OWN, PHOTO)}}
    scene, own = ((shown[name] - image).square().mean(0) for name in (SCENE, OWN))
    name = f"{case.image}, {case.factor}x\nN = {case.n:,}"  # titles are no wider than crops
    return [row for _, row in cut_crops(name, shown, scene - own if is_worst else scene, 1)]


@lru_cache(maxsize=4)
def _original(name: str, data: Path | None, factor: int) -> images.Sample:
    """Read an original, cut to whole blocks, with the map whose contours EF-PSNR looks at."""
    sample = images.load(name, data)
    labels = find_labels("given" if sample.labels is not None else "auto", *sample)[0]
    return images.whole_blocks(images.Sample(sample.image, labels), factor)


def _plot(path: Path, kinds: Mapping[str, Sequence[Row]]) -> None:
    """Plot both figures against mean seconds, a line through the N of each method."""
    plot, axes = figure(len(kinds), 2, width=9.5, height=0.6 + 2.7 * len(kinds))
    for (kind, rows), row in zip(kinds.items(), axes if len(kinds) > 1 else [axes], strict=True):
        for (axis, quantity), (index, method) in product(zip(row, QUANTITIES, strict=True), enumerate(METHODS)):
            points = [select(rows, method, n) for n in counts(rows, method)]
            x, fit, y = ([mean_over(p, q) for p in points] for q in ("seconds", "core_seconds", quantity))
            style: dict[str, Any] = {"color": COLORS[index], "marker": MARKERS[index], "markersize": 4.5}
            axis.plot(x, y, linestyle="--", label=method, **style)
            axis.plot([a + b for a, b in zip(x, fit, strict=True)], y, **style)
            axis.set(xlabel="seconds", ylabel=f"{QUANTITIES[quantity]} (dB)", xscale="log", title=kind)
    add_legend(plot, axes.flat[0], columns=len(METHODS), where="upper")
    save_figure(plot, path)
