"""The command that fits many images, and its table."""

from __future__ import annotations

import csv
import glob
import math
import os
import statistics
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from kcgs._atomic import atomic_path
from kcgs._progress import Progress

from . import options
from .common import IMAGES, Json, Quiet, app, print_report
from .fit import compile_ahead
from .many_jobs import Order, Outcome, fit_one

if TYPE_CHECKING:
    from kcgs.engine import Done

_MILLION = 1_000_000
_METRICS = ("psnr", "ssim", "ms_ssim", "ef_psnr", "ef_ssim", "num_gaussians", "seconds", "bytes", "bits_per_pixel")
_COLUMNS = ("image", *_METRICS, "stop_reason", "target_reached", "error", "core_seconds", "fit")


@app.command("fit-many")
@options.with_fit_options
def fit_many_command(
    patterns: Annotated[
        list[str], typer.Argument(metavar="PATTERN...", help="Images, folders of images, or quoted patterns.")
    ],
    *,
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the scenes or files, and results.csv.")],
    regions: Annotated[
        str, typer.Option(metavar="DIR|auto|none", help="Folder of masks with the images' stems, or auto, or none.")
    ] = "auto",
    request: options.FitRequest,
    suffix: Annotated[
        Literal[".safetensors", ".kcgs"] | None,
        typer.Option(help="What is written; default: .safetensors, with --target-bytes .kcgs."),
    ] = None,
    engine: options.EngineName = "local",
    workers: Annotated[int | None, typer.Option(min=1, help="Images at a time; default: cores / --threads.")] = None,
    threads: Annotated[int, typer.Option(min=1, help="Threads of each fit.")] = 1,
    price: Annotated[
        float | None, typer.Option("--price-per-core-hour", min=0.0, help="In dollars: what a million images cost.")
    ] = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Fit many images, each into a scene or a compressed file of its own.

    The same command again goes on where an earlier one was stopped: what is there from the same image, mask
    and settings is kept. One image's failure stops no other; with any, the exit status is 1.
    """
    if request.target_bytes is not None and suffix == ".safetensors":
        options.exclude("--target-bytes", suffix=suffix)
    images = _expand(patterns)
    masks = {} if regions in ("auto", "none") else _masks(Path(regions))
    from kcgs.engine import run_jobs

    config = request.config
    # absolute: a worker on a cluster has a working folder of its own
    output.mkdir(parents=True, exist_ok=True)
    folder, table = output.absolute(), Table(output / "results.csv")
    ending = suffix or (".safetensors" if request.target_bytes is None else ".kcgs")

    def order(image: Path) -> Order:
        target = folder / f"{image.stem}{ending}"
        return Order(image, target, regions, masks.get(image.stem, ()), request, table.get(image).get("fit", ""))

    orders = [order(image) for image in images]
    if workers is None and engine == "local":
        workers = max(1, _cores() // threads)
    # one image needs no process of its own
    workers = None if workers is None else min(workers, len(orders))
    if engine == "local" and len(orders) > 1:
        # before there are workers, each of which would compile for itself
        for program in compile_ahead(config, ending == ".kcgs" and regions != "none"):
            program.wait()
    done = run_jobs(fit_one, orders, engine=engine, workers=workers, threads=threads)
    try:
        kept, failed = _write_down(done, images, table, quiet)
    finally:
        table.write()
    missed = [image for image in images if table.get(image).get("target_reached") == "False"]
    report = _summary(table, images, kept, failed, price) | {"missed": len(missed)}
    print_report(report if as_json else {k: v for k, v in report.items() if v is not None}, as_json, str(output))
    for line in failed.values():
        typer.echo(f"kcgs: {line}", err=True)
    if missed:
        names = ", ".join(image.name for image in missed)
        typer.echo(f"kcgs: the target was missed by {names}", err=True)
    if failed or missed:
        raise typer.Exit(1)


class Table:
    """Rows by the stem of their image; those of an earlier call are kept."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._rows: dict[str, dict[str, str]] = {}
        if path.is_file():
            with path.open(newline="", encoding="utf-8") as file:
                # a row that was cut off by a kill is not there
                rows = [row for row in csv.DictReader(file) if set(row) == set(_COLUMNS) and None not in row.values()]
            self._rows = {Path(row["image"]).stem: row for row in rows}
        self.write()

    def get(self, image: Path) -> dict[str, str]:
        """Return an image's row, empty where there is none."""
        return self._rows.get(image.stem, {})

    def put(self, image: Path, **values: Any) -> None:
        """Set an image's row, and write it down at once; what is not said is left empty."""
        row = {"image": str(image), **{name: _text(values.get(name, "")) for name in _COLUMNS[1:]}}
        self._rows[image.stem] = row
        with self._path.open("a", newline="", encoding="utf-8") as file:
            csv.DictWriter(file, _COLUMNS).writerow(row)

    def write(self) -> None:
        """Write the table anew, sorted, one row per image: appended rows are in the order in which fits end."""
        with atomic_path(self._path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, _COLUMNS)
            writer.writeheader()
            writer.writerows(self._rows[stem] for stem in sorted(self._rows))

    def column(self, name: str, images: list[Path]) -> list[float]:
        """Return the numbers of a column, where there are any."""
        return [float(text) for image in images if (text := self.get(image).get(name))]


def _text(value: Any) -> str:
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.6g}"
    return "" if value is None else str(value)


def _expand(patterns: list[str]) -> list[Path]:
    """Return the images that patterns mean, as absolute paths, each once; those that share a stem are refused."""
    images: dict[Path, None] = {}
    others = 0
    for pattern in patterns:
        path = Path(pattern)
        if path.is_file():
            found = [path]
        else:
            names = path.iterdir() if path.is_dir() else map(Path, glob.glob(pattern, recursive=True))
            files = [name for name in names if name.is_file()]
            found = sorted(name for name in files if name.suffix.lower() in IMAGES)
            others += len(files) - len(found)
        if not found:
            raise FileNotFoundError(f"PATTERN must name images; nothing found for {pattern!r}")
        images |= dict.fromkeys(name.absolute() for name in found)
    by_stem: dict[str, list[str]] = {}
    for image in images:
        by_stem.setdefault(image.stem, []).append(str(image))
    if clashes := [" and ".join(paths) for paths in by_stem.values() if len(paths) > 1]:
        raise typer.BadParameter(
            f"PATTERN must name images of different stems, after which scenes are named; got {'; '.join(clashes)}"
        )
    if others:
        typer.echo(f"kcgs: {others} {'files' if others > 1 else 'file'} of other kinds skipped", err=True)
    return list(images)


def _masks(folder: Path) -> dict[str, tuple[Path, ...]]:
    if not folder.is_dir():
        raise typer.BadParameter(f"--regions must be auto, none or a folder of masks; got {str(folder)!r}")
    found: dict[str, tuple[Path, ...]] = {}
    for path in sorted(folder.absolute().iterdir()):
        if path.suffix.lower() in (*IMAGES, ".npy"):
            found[path.stem] = (*found.get(path.stem, ()), path)
    return found


def _cores() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _write_down(
    done: Iterable[Done[Outcome]], images: list[Path], table: Table, quiet: bool
) -> tuple[int, dict[Path, str]]:
    """Put what ends into the table; return how many were kept, and what to say of those that failed."""
    kept, count, failed = 0, 0, dict[Path, str]()
    with Progress("fit-many", shown=not quiet) as progress:
        try:
            for count, ended in enumerate(done, 1):
                image, outcome = images[ended.index], ended.result
                if outcome is None:
                    failed[image] = f"{image.name}: {ended.error}"
                    table.put(image, error=str(ended.error))
                elif outcome.metrics is None:
                    kept += 1
                else:
                    kept += math.isnan(outcome.core_seconds)
                    table.put(image, **outcome.metrics, core_seconds=outcome.core_seconds, fit=outcome.fit)
                for warning in () if outcome is None else outcome.warnings:
                    typer.echo(f"{image.name}: {warning}", err=True)
                told = f"{count} of {len(images)}" + (f", {len(failed)} failed" if failed else "")
                progress.update(count / len(images), told)
        except KeyboardInterrupt:
            failures = f", {len(failed)} failed" if failed else ""
            told = f"{count - len(failed)} of {len(images)} images are done{failures}"
            raise KeyboardInterrupt(f"{told}; the same command goes on") from None
    return kept, failed


def _summary(
    table: Table, images: list[Path], kept: int, failed: dict[Path, str], price: float | None
) -> dict[str, Any]:
    """Sum up the images of this call; cost is that of all of them that were ever measured in this folder."""
    good = [image for image in images if image not in failed]
    counts = {"images": len(images), "fitted": len(good) - kept, "kept": kept, "failed": len(failed)}
    report: dict[str, Any] = dict(counts)
    for name in ("psnr", "ef_psnr", "num_gaussians", "bits_per_pixel", "core_seconds"):
        values = table.column(name, good)
        report[f"mean_{name}"] = statistics.fmean(values) if values else None
    seconds = report["mean_core_seconds"]
    hours = None if seconds is None else seconds * _MILLION / 3600
    report["core_hours_per_million"] = hours
    report["dollars_per_million"] = None if hours is None or price is None else hours * price
    return report
