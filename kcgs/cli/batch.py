"""The command that fits many images."""

from __future__ import annotations

import glob
import math
import os
import statistics
from collections.abc import Iterable
from enum import Enum
from pathlib import Path
from typing import Annotated, Any

import typer

from kcgs.engine import Done, run_jobs

from .common import IMAGES, Json, app, print_report
from .many import Order, Outcome, fit_one
from .options import (
    DEFAULT_GAUSSIANS,
    Backend,
    Engine,
    EngineName,
    Gaussians,
    Iterations,
    KeepContours,
    KernelName,
    MaxSeconds,
    Recipe,
    Seed,
    TargetBytes,
    TargetPsnr,
    check_budget,
    make_config,
)
from .table import Table


class Suffix(str, Enum):
    """What is written of an image."""

    scene = ".safetensors"
    file = ".kcgs"


_MILLION = 1_000_000


@app.command("fit-many")
def fit_many_command(
    patterns: Annotated[
        list[str], typer.Argument(metavar="PATTERN...", help="Images, folders of images, or quoted patterns.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the scenes or files, and results.csv.")],
    regions: Annotated[
        str,
        typer.Option(metavar="DIR|auto|none", help="Folder of masks with the images' stems, or auto, or none."),
    ] = "auto",
    num_gaussians: Gaussians = None,
    recipe: Recipe = "best",
    iterations: Iterations = None,
    max_seconds: MaxSeconds = None,
    target_psnr: TargetPsnr = None,
    target_bytes: TargetBytes = None,
    suffix: Annotated[
        Suffix | None, typer.Option(help="What is written; default: .safetensors, with --target-bytes .kcgs.")
    ] = None,
    keep_contours: KeepContours = False,
    seed: Seed = 0,
    backend: KernelName = Backend.auto,
    engine: EngineName = Engine.local,
    workers: Annotated[int | None, typer.Option(min=1, help="Images at a time; default: cores / --threads.")] = None,
    threads: Annotated[int, typer.Option(min=1, help="Threads of each fit.")] = 1,
    price: Annotated[
        float | None, typer.Option("--price-per-core-hour", min=0.0, help="In dollars: what a million images cost.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Fit many images, each into a scene or a compressed file of its own.

    The same command again goes on where an earlier one was stopped: what is there from the same image, mask
    and settings is kept. One image's failure stops no other; with any, the exit status is 1.
    """
    check_budget(target_bytes, num_gaussians=num_gaussians, target_psnr=target_psnr)
    if target_bytes is not None and suffix is Suffix.scene:
        raise typer.BadParameter("--target-bytes is the size of a .kcgs file and excludes --suffix .safetensors")
    images = _expand(patterns)
    config = make_config(
        recipe, regions, iterations=iterations, max_seconds=max_seconds, target_psnr=target_psnr,
        keep_contours=keep_contours, backend=backend,
    )  # fmt: skip
    masks = {} if regions in ("auto", "none") else _masks(Path(regions))
    # absolute: a worker on a cluster has a working folder of its own
    output.mkdir(parents=True, exist_ok=True)
    folder, table = output.absolute(), Table(output / "results.csv")
    count = DEFAULT_GAUSSIANS if num_gaussians is None else num_gaussians
    ending = suffix or (Suffix.scene if target_bytes is None else Suffix.file)

    def order(image: Path) -> Order:
        known = table.get(image).get("fit", "")
        target, own = folder / f"{image.stem}{ending.value}", masks.get(image.stem, ())
        return Order(image, target, regions, own, count, target_bytes, recipe, config, seed, known)

    orders = [order(image) for image in images]
    if workers is None and engine is Engine.local:
        workers = max(1, _cores() // threads)
    # one image needs no process of its own
    workers = None if workers is None else min(workers, len(orders))
    done = run_jobs(fit_one, orders, engine=engine.value, workers=workers, threads=threads)
    try:
        kept, failed = _write_down(done, images, table)
    finally:
        table.write()
    report = _summary(table, images, kept, failed, price)
    print_report(report if as_json else {k: v for k, v in report.items() if v is not None}, as_json, str(output))
    for line in failed.values():
        typer.echo(f"kcgs: {line}", err=True)
    if failed:
        raise typer.Exit(1)


def _expand(patterns: list[str]) -> list[Path]:
    """Return the images that patterns mean, as absolute paths, each once; two with one stem are refused."""
    images: dict[Path, None] = {}
    for pattern in patterns:
        path = Path(pattern)
        if path.is_file():
            found = [path]
        else:
            names = path.iterdir() if path.is_dir() else map(Path, glob.glob(pattern, recursive=True))
            found = sorted(name for name in names if name.suffix.lower() in IMAGES and name.is_file())
        if not found:
            raise ValueError(f"PATTERN must name images; nothing found for {pattern!r}")
        images |= dict.fromkeys(name.absolute() for name in found)
    by_stem: dict[str, Path] = {}
    for image in images:
        other = by_stem.setdefault(image.stem, image)
        if other != image:
            raise ValueError(f"images must have different stems, after which scenes are named; got {other} and {image}")
    return list(images)


def _masks(folder: Path) -> dict[str, tuple[Path, ...]]:
    if not folder.is_dir():
        raise ValueError(f"--regions must be auto, none or a folder of masks; got {str(folder)!r}")
    found: dict[str, tuple[Path, ...]] = {}
    for path in sorted(folder.absolute().iterdir()):
        if path.suffix.lower() in (*IMAGES, ".npy", ".gif"):
            found[path.stem] = (*found.get(path.stem, ()), path)
    return found


def _cores() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _write_down(done: Iterable[Done[Outcome]], images: list[Path], table: Table) -> tuple[int, dict[Path, str]]:
    """Put what ends into the table; return how many were kept, and what to say of those that failed."""
    from rich.console import Console
    from rich.progress import MofNCompleteColumn, Progress, TimeRemainingColumn

    kept, failed = 0, dict[Path, str]()
    console = Console(stderr=True)
    columns = (*Progress.get_default_columns()[:2], MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("fit", total=len(images))
        for ended in done:
            image, outcome = images[ended.index], ended.result
            if outcome is None:
                failed[image] = f"{image.name}: {ended.error}"
                table.put(image, error=str(ended.error))
            elif outcome.figures is None:
                kept += 1
            else:
                kept += math.isnan(outcome.core_seconds)
                table.put(image, **outcome.figures, core_seconds=outcome.core_seconds, fit=outcome.fit)
            for warning in () if outcome is None else outcome.warnings:
                console.print(f"{image.name}: {warning}", markup=False, highlight=False, soft_wrap=True)
            progress.update(task, advance=1, description=f"fit, {len(failed)} failed" if failed else "fit")
    return kept, failed


def _summary(
    table: Table, images: list[Path], kept: int, failed: dict[Path, str], price: float | None
) -> dict[str, Any]:
    """Sum up the images of this call; cost is that of all of them that were ever measured in this folder."""
    good = [image for image in images if image not in failed]
    report: dict[str, Any] = {
        "images": len(images),
        "fitted": len(good) - kept,
        "kept": kept,
        "failed": len(failed),
    }
    for name in ("psnr", "ef_psnr", "num_gaussians", "bits_per_pixel", "core_seconds"):
        values = table.column(name, good)
        report[f"mean_{name}"] = statistics.fmean(values) if values else None
    seconds = report["mean_core_seconds"]
    hours = None if seconds is None else seconds * _MILLION / 3600
    report["core_hours_per_million"] = hours
    report["dollars_per_million"] = None if hours is None or price is None else hours * price
    return report
