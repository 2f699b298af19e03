"""The command fit-many, and its table of results."""

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
from kcgs._suffixes import IMAGES, LABEL_MAPS
from kcgs.errors import InvalidArgument

from . import options
from .commands import app
from .common import INTERRUPTED, Json, Quiet
from .many_batches import make_batches, run_batch, single_image_option
from .many_fingerprints import FitJob
from .many_jobs import Outcome
from .many_shards import Shards
from .reports import print_report
from .saving import file_config


def _check_batch(value: str) -> str:
    """Validate --batch: auto or a number of images."""
    if value != "auto" and not (value.isdigit() and int(value) > 0):
        raise InvalidArgument("batch", "auto, or a number of images", repr(value))
    return value


@app.command("fit-many")
@options.with_fit_options
def fit_many_command(
    images: Annotated[list[Path], typer.Argument(metavar="FOLDER...", help="Folders of images, or images.")],
    *,
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the scenes or files, and results.csv.")],
    regions: Annotated[
        str,
        typer.Option(
            metavar="DIR|auto|none",
            help=f"Folder of masks with the images' stems, or auto (segment each image, {options.IF_LARGE}), or none.",
        ),
    ] = "auto",
    request: options.FitRequest,
    suffix: Annotated[
        Literal[".safetensors", ".kcgs"] | None,
        typer.Option(help="Suffix of the files; default: .safetensors, with --target-bytes .kcgs."),
    ] = None,
    engine: Annotated[
        Literal["local", "ray"],
        typer.Option(help="local: processes of this machine; ray: the cluster at RAY_ADDRESS, or one started here."),
    ] = "local",
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="Batches at a time; default: cores / --threads, with --device cuda two per GPU."),
    ] = None,
    threads: Annotated[int, typer.Option(min=1, help="Threads of each fit.")] = 1,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace files made with other settings or changed since.")
    ] = False,
    batch: Annotated[
        str,
        typer.Option(metavar="auto|N", callback=_check_batch, help="Images of one size that are fitted together."),
    ] = "auto",
    shard: Annotated[
        int | None,
        typer.Option(min=1, help="Scenes of a file 00000.safetensors, ..., in place of a file for each image."),
    ] = None,
    threshold: options.Threshold = None,
    resize_regions: options.ResizeRegions = False,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Fit many images, each into a scene or a compressed file of its own, or many into a shard.

    Images of one size are fitted together, which is faster and gives the same scenes on a CPU.

    The same command again goes on where an earlier one stopped: a file that was made from the same image, mask and
    settings, and not changed since, is kept; any other file that exists is an error of that image without --overwrite.
    With --shard, images and masks are the same if their names and sizes in bytes are.
    One image's failure stops no other; with any, the exit status is 1.

    The table counts images: fitted now, kept from an earlier run, failed, and missed, which are fitted or kept but do
    not reach --target-psnr.
    """
    if request.target_bytes is not None and suffix == ".safetensors":
        options.exclude("--target-bytes", suffix=suffix)
    if regions in ("auto", "none"):
        options.exclude(f"--regions {regions}", threshold=threshold)
    if shard is not None:
        options.exclude("--shard", suffix=suffix, target_bytes=request.target_bytes)
    jobs = [
        FitJob(
            image,
            output.absolute() / f"{stem}{suffix or request.default_suffix}",
            mask,
            request,
            overwrite,
            resize_regions,
            threshold,
        )
        for stem, image, mask in _find_images(images, regions)
    ]
    from kcgs.engine import run_jobs

    file_config(jobs[0].output, request)  # refuses wrong settings before the work
    single = single_image_option(request)
    if single is not None and batch not in ("auto", "1"):
        options.exclude(f"--{single}", batch=batch)
    devices = _list_devices(request) if engine == "local" else [request.device]
    on_gpu = devices[0].startswith("cuda")
    if workers is None and engine == "local":
        # two processes per GPU: one reads and writes files while the other fits
        workers = 2 * len(devices) if on_gpu else max(1, _count_cores() // threads)
    batches = make_batches(jobs, "1" if single else batch, shard, workers or 1, devices, output)
    workers = None if workers is None else min(workers, len(batches))
    shards = Shards([batch.work for batch in batches])
    shards.check()
    output.mkdir(parents=True, exist_ok=True)
    outcomes = dict[int, Outcome]()
    try:
        with Progress("fit-many", visible=not quiet) as progress:
            work = run_jobs(run_batch, batches, engine=engine, workers=workers, threads=threads, gpus=int(on_gpu))
            for number, results in work:
                for index, outcome in zip(batches[number].indices, results, strict=True):
                    outcomes[index] = outcome
                    for warning in outcome.warnings:
                        typer.echo(f"warning: {jobs[index].image.name}: {warning}", err=True)
                progress.update(len(outcomes) / len(jobs), f"{len(outcomes)} of {len(jobs)}")
                shards.add(batches[number].work, results)
    except KeyboardInterrupt:
        # a worker may have written a file without the main process knowing
        done = f"{sum(batch.work.count_done() for batch in batches)} of {len(jobs)} images are done"
        typer.echo(f"kcgs: interrupted: {done}; the same command goes on where it stopped", err=True)
        raise typer.Exit(INTERRUPTED) from None
    finally:
        rows = [{"image": str(jobs[index].image), **outcomes[index].row} for index in sorted(outcomes)]
        if any("error" not in row for row in rows):  # if all images failed, an older table stays
            _write_table(output / "results.csv", rows)
    num_kept = sum(not outcome.is_new and "error" not in outcome.row for outcome in outcomes.values())
    _report_rows(rows, num_kept, output, as_json)


def _report_rows(rows: list[dict[str, Any]], num_kept: int, output: Path, as_json: bool) -> None:
    """Print how many images were fitted, and which failed or missed their target; with any, exit status 1."""
    failures = [row for row in rows if "error" in row]
    misses = [row for row in rows if row.get("target_reached") is False]
    counts = {
        "images": len(rows), "fitted": len(rows) - len(failures) - num_kept, "kept": num_kept,
        "failed": len(failures), "missed": len(misses),
    }  # fmt: skip
    print_report(counts | _means(rows), as_json, str(output))
    for row in failures:
        typer.echo(f"kcgs: {Path(row['image']).name}: {row['error']}", err=True)
    if misses:
        names = ", ".join(Path(row["image"]).name for row in misses)
        typer.echo(f"kcgs: --target-psnr was not reached by {names}", err=True)
    if failures or misses:
        raise typer.Exit(1)


def _find_images(paths: list[Path], regions: str) -> list[tuple[str, Path, str]]:
    """Return each image's stem, its path and its regions: auto, none or a path.

    Paths are absolute, since a worker on a cluster has its own working folder.
    """
    images = _by_stem("images", (image for path in paths for image in _list_images(path)))
    if regions in ("auto", "none"):
        sources = dict.fromkeys(images, regions)
    else:
        files = (path for path in Path(regions).iterdir() if path.suffix.lower() in LABEL_MAPS)
        masks = _by_stem("regions", files)
        sources = {stem: str(masks.get(stem, Path(regions, f"{stem}.*")).absolute()) for stem in images}
    return [(stem, image.absolute(), sources[stem]) for stem, image in images.items()]


def _list_images(path: Path) -> list[Path]:
    if not path.is_dir():
        path.stat()  # raises FileNotFoundError
        return [path]
    images = sorted(file for file in path.iterdir() if file.suffix.lower() in IMAGES)
    if not images:
        expected = f"images ({', '.join(IMAGES)})"
        raise InvalidArgument("images", expected, f"{str(path)!r} without any", verb="hold")
    return images


def _by_stem(name: str, files: Iterable[Path]) -> dict[str, Path]:
    """Return files by their stem, which names their scenes; `name` is the name of the parameter."""
    by_stem = dict[str, Path]()
    for file in files:
        if by_stem.setdefault(file.stem, file) != file:
            raise InvalidArgument(name, "different stems", f"{by_stem[file.stem]} and {file}", verb="have")
    return by_stem


def _list_devices(request: options.FitRequest) -> list[str]:
    """Return the devices of the option --device: "cuda" means all GPUs of the machine; refuse a device that is none."""
    import torch

    count = torch.cuda.device_count() if request.device == "cuda" else 0
    return [f"cuda:{number}" for number in range(count)] or [str(request.load_device())]


def _count_cores() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _write_table(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write a table with a column for each figure of the reports, errors last."""
    figures = dict.fromkeys(name for row in rows for name in row if name not in ("error", "fingerprint"))
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [*(figures or ["image"]), "error"], extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)


def _means(rows: list[dict[str, Any]]) -> dict[str, float]:
    means = dict[str, float]()
    for name in ("psnr", "ef_psnr", "num_gaussians", "bits_per_pixel", "seconds"):
        values = [row[name] for row in rows if row.get(name) is not None]
        if values:
            means[f"mean_{name}"] = statistics.fmean(values)
        if values and name == "psnr":
            means["median_psnr"] = statistics.median(values)
    return means
