"""The command that fits many images, and its table."""

from __future__ import annotations

import csv
import os
import statistics
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from kcgs._atomic import atomic_path
from kcgs._progress import Progress

from . import options
from .common import IMAGES, LABEL_MAPS, Json, Quiet, app, print_report
from .many_jobs import Order, Outcome, fit_one

_METRICS = ("psnr", "ssim", "ms_ssim", "ef_psnr", "ef_ssim", "num_gaussians", "seconds", "bytes", "bits_per_pixel")
_COLUMNS = ("image", *_METRICS, "stop_reason", "target_reached", "error")


@app.command("fit-many")
@options.with_fit_options
def fit_many_command(
    paths: Annotated[list[Path], typer.Argument(metavar="FOLDER...", help="Folders of images, or images.")],
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
    engine: Annotated[
        Literal["local", "ray"],
        typer.Option(help="local: processes of this machine; ray: the cluster at RAY_ADDRESS, or one started here."),
    ] = "local",
    workers: Annotated[int | None, typer.Option(min=1, help="Images at a time; default: cores / --threads.")] = None,
    threads: Annotated[int, typer.Option(min=1, help="Threads of each fit.")] = 1,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Fit many images, each into a scene or a compressed file of its own.

    The same command again goes on where an earlier one was stopped: what is there from the same image, mask
    and settings is kept. One image's failure stops no other; with any, the exit status is 1.
    """
    if request.target_bytes is not None and suffix == ".safetensors":
        options.exclude("--target-bytes", suffix=suffix)
    ending = suffix or (".safetensors" if request.target_bytes is None else ".kcgs")
    orders = _make_orders(paths, regions, output, ending, request)
    from kcgs.engine import run_jobs

    _ = request.config  # refuses wrong settings before the work
    output.mkdir(parents=True, exist_ok=True)
    if workers is None and engine == "local":
        workers = max(1, _count_cores() // threads)
    workers = None if workers is None else min(workers, len(orders))
    done = run_jobs(fit_one, orders, engine=engine, workers=workers, threads=threads)
    outcomes = dict[int, Outcome]()
    try:
        with Progress("fit-many", shown=not quiet) as progress:
            for index, outcome in done:
                outcomes[index] = outcome
                progress.update(len(outcomes) / len(orders), f"{len(outcomes)} of {len(orders)}")
                for warning in outcome.warnings:
                    typer.echo(f"{orders[index].image.name}: {warning}", err=True)
    finally:
        rows = [{"image": str(orders[index].image), **outcomes[index].row} for index in sorted(outcomes)]
        _write_table(output / "results.csv", rows)
    failed = [row for row in rows if "error" in row]
    missed = [row for row in rows if row.get("target_reached") is False]
    fitted = sum(outcome.is_new for outcome in outcomes.values()) - len(failed)
    counts = {"images": len(rows), "fitted": fitted, "failed": len(failed), "missed": len(missed)}
    print_report(counts | _means(rows), as_json, str(output))
    for row in failed:
        typer.echo(f"kcgs: {Path(row['image']).name}: {row['error']}", err=True)
    if missed:
        names = ", ".join(Path(row["image"]).name for row in missed)
        typer.echo(f"kcgs: --target-psnr was not reached by {names}", err=True)
    if failed or missed:
        raise typer.Exit(1)


def _make_orders(
    paths: list[Path], regions: str, output: Path, ending: str, request: options.FitRequest
) -> list[Order]:
    """Return an order for each image; paths are absolute, for a worker on a cluster has a working folder of its own."""
    images = _by_stem(image for path in paths for image in _list_images(path))
    if regions in ("auto", "none"):
        sources = dict.fromkeys(images, regions)
    else:
        masks = _by_stem(path for path in Path(regions).iterdir() if path.suffix.lower() in LABEL_MAPS)
        sources = {stem: str(masks.get(stem, Path(regions, f"{stem}.*")).absolute()) for stem in images}
    return [
        Order(image.absolute(), output.absolute() / f"{stem}{ending}", sources[stem], request)
        for stem, image in images.items()
    ]


def _list_images(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    found = sorted(file for file in path.iterdir() if file.suffix.lower() in IMAGES)
    if not found:
        raise typer.BadParameter(f"FOLDER must hold images ({', '.join(IMAGES)}); there is none in {str(path)!r}")
    return found


def _by_stem(files: Iterable[Path]) -> dict[str, Path]:
    """Return files by their stem, after which scenes are named."""
    found = dict[str, Path]()
    for file in files:
        if found.setdefault(file.stem, file) != file:
            raise typer.BadParameter(f"files must have different stems; got {found[file.stem]} and {file}")
    return found


def _count_cores() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _write_table(path: Path, rows: list[dict[str, Any]]) -> None:
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, _COLUMNS, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)


def _means(rows: list[dict[str, Any]]) -> dict[str, float]:
    means = dict[str, float]()
    for name in ("psnr", "ef_psnr", "num_gaussians", "bits_per_pixel", "seconds"):
        values = [row[name] for row in rows if row.get(name) is not None]
        if values:
            means[f"mean_{name}"] = statistics.fmean(values)
    return means
