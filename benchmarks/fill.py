"""What deleted and moved objects uncover, filled and not: `python -m benchmarks fill`."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from kcgs.editing import delete_region, move_region
from kcgs.scene import Scene

from .core.cases import BEST, plan
from .core.clocks import threads
from .core.figures import save_sheet
from .core.images import FRAMES, sequences
from .core.jobs import check_made
from .core.options import Options
from .core.registry import experiment
from .core.report import Made, conclude
from .core.rows import read_rows, write_rows
from .core.store import Store
from .core.tables import count, markdown, number, seconds

COUNT, QUICK_COUNT, QUICK_STRIDE = 3_000, 60, 4
FILLS = {"before": None, "filled": "inpaint"}
# around the hole, in pixels: what is compared with it, what is filled with it, the contour of a moved object, a crop
_AROUND, _FRINGE, _CONTOUR, _SHOWN = 40, 3, 2, 45
_INTRODUCTION = f"""The object of each frame is deleted, and moved to the side by a third of its width, away from the
nearer border; `before` is with `fill=None`, `filled` with `fill="inpaint"`. All figures are of the pixels that are
uncovered; those within {_CONTOUR} pixels of a moved object are left out. A pixel is steep whose gradient is above the
99.9th percentile of the {_AROUND} pixels around; the steepest is given as its multiple. Changed are pixels more than
{_FRINGE} from the hole, by more than 0.05. Seconds are those of one core."""


class Result(NamedTuple):
    """An edit with a fill."""

    image: str
    edit: str
    fill: str
    pixels: int  # that are uncovered
    low: float  # least value there
    high: float
    steep: int  # pixels there
    ratio: float  # of the steepest to the percentile around
    changed: int  # pixels outside
    core_seconds: float
    added: int  # Gaussians more than with the edit alone


def report(output: Path, made: Made) -> list[str]:
    """Write the report's parts."""
    results = read_rows(output / "results.csv", Result)
    parts = ["# Holes of deleted and moved objects", _INTRODUCTION]
    for edit in dict.fromkeys(r.edit for r in results):
        before, filled = ([r for r in results if (r.edit, r.fill) == (edit, fill)] for fill in FILLS)
        low, high, steep = min(r.low for r in filled), max(r.high for r in filled), sum(r.steep for r in filled)
        longest, lines = max(r.core_seconds for r in filled), []
        for both in zip(before, filled, strict=True):
            line = [both[0].image, count(both[0].pixels), *(f"{r.low:.2f} to {r.high:.2f}" for r in both)]
            line += [count(r.steep) for r in both] + [number(r.ratio) for r in both]
            lines.append([*line, count(both[1].changed), count(both[1].added), seconds(both[1].core_seconds)])
        pairs = [f"{what}, {when}" for what in ("values", "steep", "steepest") for when in FILLS]
        table = markdown(["image", "pixels", *pairs, "changed", "added", "s"], lines)
        text = f"Filled: values from {low:.3f} to {high:.3f}; steep pixels: {steep}; {longest:.1f} s at most."
        sheet = f"[All frames around the hole, at full size]({edit}.jpg): the scene, before, filled."
        parts += [f"## {edit}", text, table, sheet]
    return parts


@experiment("engine", "workers", "runs", report=report)
def run(output: Path, options: Options) -> None:
    """Fit frames, then delete and move their objects, here and on one thread."""
    names = ["disc"] if options.quick else sequences(options.data, ",".join(FRAMES), quick=False)
    wanted = plan(names, [QUICK_COUNT if options.quick else COUNT], [BEST], options, 0, QUICK_STRIDE)
    store = Store.open(output, options)
    failed = store.obtain(wanted, options.place)
    results, sheets = list[Result](), dict[str, list[tuple[str, dict[str, Tensor]]]]()
    with threads(1):
        for case in (case for case in wanted if store.row(case) is not None):
            for edit in edits(scene := store.scene(case)):
                found, images = compare(case.image, scene, *edit)
                results += found
                sheets.setdefault(edit[0], []).append((case.image, images))
    write_rows(output / "results.csv", Result, results)
    for name, frames in sheets.items():
        save_sheet(output / f"{name}.jpg", frames)
    conclude(report, output, options.made("fill"))
    check_made(failed)


def edits(scene: Scene) -> list[tuple[str, Callable[..., Scene], Tensor, Tensor]]:
    """List edits of what is not region 0: name, function of `fill`, where it was or is, what is uncovered, (H, W)."""
    assert scene.regions is not None
    ids = [region for region in scene.regions.ids.tolist() if region != 0]
    hole = torch.isin(scene.regions.labels, torch.tensor(ids))
    if not ids or hole.all():
        return []
    columns = hole.any(0).nonzero().flatten().tolist()
    left, width = columns[0], columns[-1] + 1 - columns[0]
    step = max(1, round(width / 3)) * (1 if 2 * left + width <= hole.shape[1] else -1)
    landed = pad(hole, (step, -step))
    apply = partial(delete_region, scene, ids), partial(move_region, scene, ids, (step, 0))
    return [("delete", apply[0], hole, hole), ("move", apply[1], hole | landed, hole & ~grow(landed, _CONTOUR))]


def compare(
    image: str, scene: Scene, called: str, apply: Callable[..., Scene], hole: Tensor, uncovered: Tensor
) -> tuple[list[Result], dict[str, Tensor]]:
    """Measure an edit with each fill; return crops of the scene and of both, too."""
    around, outside = grow(hole, _AROUND) & ~hole, ~grow(hole, _FRINGE)
    rows, cols = (grow(hole, _SHOWN).any(axis) for axis in (1, 0))
    shown, results, alone = {"scene": scene.render()}, list[Result](), scene
    for name, fill in FILLS.items():
        start = time.process_time()
        edited = apply(fill=fill)
        spent = time.process_time() - start
        alone = edited if fill is None else alone
        values, shown[name] = edited().detach(), edited.render()
        slopes = torch.stack(torch.gradient(values.double(), dim=(1, 2))).norm(dim=0).amax(0)
        there, slope = values[:, uncovered], slopes[uncovered] / slopes[around].quantile(0.999)
        changed = int(((shown[name] - shown["before"]).abs().amax(0)[outside] > 0.05).sum())
        figures: list[Any] = [len(slope), float(there.min()), float(there.max()), int((slope > 1).sum())]
        figures += [float(slope.max()), changed, spent, edited.num_gaussians - alone.num_gaussians]
        results.append(Result(image, called, name, *figures))
    return results, {name: whole[:, rows][..., cols] for name, whole in shown.items()}


def grow(mask: Tensor, reach: int) -> Tensor:
    """Add the pixels within so many of a mask (H, W)."""
    return max_pool2d(mask[None].float(), 2 * reach + 1, 1, reach)[0] > 0
