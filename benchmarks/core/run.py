"""An experiment: measure jobs, keep their rows on disk, write a report of one page."""

from __future__ import annotations

import csv
import hashlib
import inspect
import json
import os
import platform
import subprocess
from collections.abc import Callable, Sequence
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import torch
from rich.progress import track

import kcgs
from kcgs.engine import run_jobs

Row = dict[str, Any]
Job = dict[str, Any]
Measure = Callable[..., list[Row]]
RESULTS_FILE = "results.csv"
DIFFERENCES_FILE = "differences.csv"
# holds the command, the tree of kcgs, the machine, and a note if jobs are missing
RUN_FILE = "run.json"
QUICK_NOTE = "This is the short form, with small images and few iterations: it only shows that all of it runs."


class Options(NamedTuple):
    """The options of the command."""

    output: Path
    data: Path | None = None
    quick: bool = False
    only: tuple[str, ...] = ()  # images, or scenes of the zoo
    workers: int = 1
    redraw: bool = False

    def folder(self) -> Path:
        """Return the folder of the data; raise a ValueError if there is none."""
        if self.data is None:
            raise ValueError("data must be a folder with images; got None")
        return self.data

    def image_arguments(self) -> dict[str, Any]:
        """Return arguments of `images.load` as values that JSON can hold."""
        return {"data": str(self.data or ""), "quick": self.quick}


class Page(NamedTuple):
    """A report; its question is the first line of the module."""

    answer: str  # in two sentences
    figure: str  # file beside the report
    table: str
    losses: str
    method: str  # what is measured, and how
    differences: Sequence[Row] = ()  # with their intervals


def run_experiment(
    name: str,
    options: Options,
    jobs: Callable[[Options], list[Job]],
    measure: Measure,
    page: Callable[[Path, list[Row]], Page],
) -> None:
    """Measure the jobs without a result, then write results.csv, run.json and report.md.

    A job is the keyword arguments of `measure`, a function of a module, which returns rows of JSON's values. The rows
    are kept in OUTPUT/runs, under a hash of the job and of the code of kcgs and of the benchmarks, but for what is
    below `page`; remove the folder to measure anew. An interruption leaves the results so far: `--redraw` reports them,
    and the same command goes on.
    """
    if not options.redraw:
        _measure_all(name, options, jobs(options), measure)
    _write_report(options.output, page)


def _measure_all(name: str, options: Options, jobs: list[Job], measure: Measure) -> None:
    """Measure the jobs without a result, and write the rows of all that are done, also after an interruption."""
    selection = [job for job in jobs if not options.only or {job["image"], job.get("comparison")} & {*options.only}]
    if not selection:
        raise ValueError(f"only must name some of {', '.join({job['image']: 0 for job in jobs})}")
    options.output.mkdir(parents=True, exist_ok=True)
    paths = {_path(options.output / "runs", measure, job): job for job in selection}
    try:
        _measure_missing(measure, paths, options.workers)
    finally:
        done = [path for path in paths if path.is_file()]
        rows = [row for path in done for row in json.loads(path.read_text())]
        write_rows(options.output / RESULTS_FILE, rows)
        note = f"Stopped: {len(done)} of {len(paths)} jobs are done." if len(done) < len(paths) else ""
        run = {"command": _command(name, options), "quick": options.quick, "tree": _tree(), "machine": _machine()}
        run["note"] = note
        (options.output / RUN_FILE).write_text(json.dumps(run, indent=1) + "\n", encoding="utf-8")


def _write_report(folder: Path, page: Callable[[Path, list[Row]], Page]) -> None:
    """Write report.md, and the differences with their intervals, from the results in a folder."""
    run = json.loads((folder / RUN_FILE).read_text(encoding="utf-8"))
    report = page(folder, read_rows(folder / RESULTS_FILE))
    if report.differences:
        write_rows(folder / DIFFERENCES_FILE, report.differences)
    question, _, _ = (_module_of(page).__doc__ or "").partition("\n")
    (folder / "report.md").write_text(_text(question, report, run), encoding="utf-8")


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write rows as CSV, floats with six digits."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(name for row in rows for name in row)))
        writer.writeheader()
        for row in rows:
            writer.writerow({key: f"{value:.6g}" if isinstance(value, float) else value for key, value in row.items()})


def read_rows(path: Path) -> list[Row]:
    """Read what `write_rows` wrote: numbers where they are numbers, names of images always as text."""
    with path.open(newline="", encoding="utf-8") as file:
        return [
            {name: text if name == "image" else _number(text) for name, text in row.items() if text}
            for row in csv.DictReader(file)
        ]


def _number(text: str) -> float | int | str:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def _module_of(function: Callable[..., Any]) -> ModuleType:
    module = inspect.getmodule(function)
    assert module is not None
    return module


def _path(folder: Path, measure: Measure, job: Job) -> Path:
    parts = [measure.__module__, job, _sources()]
    key = hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()
    return folder / f"{str(job['image']).replace('/', '-')}-{key[:20]}.json"


@cache
def _sources() -> str:
    """Hash what kcgs and the benchmarks measure with, not what is below a line `def page(`: this only reports."""
    digest = hashlib.sha256()
    folders = Path(kcgs.__file__).parent, Path(__file__).parent.parent
    for path in (path for folder in folders for path in sorted(folder.rglob("*"))):
        if path.suffix in (".py", ".toml", ".bin"):
            digest.update(path.read_bytes().partition(b"\ndef page(")[0])
    return digest.hexdigest()


def _measure_missing(measure: Measure, paths: dict[Path, Job], workers: int) -> None:
    jobs_to_run = [(path, job) for path, job in paths.items() if not path.is_file()]
    for _ in track(
        run_jobs(partial(_measure, measure), jobs_to_run, workers=workers), "benchmark", total=len(jobs_to_run)
    ):
        pass


def _measure(measure: Measure, item: tuple[Path, Job]) -> None:
    """Measure a job; its file appears whole or not at all."""
    path, job = item
    rows = measure(**job)
    path.parent.mkdir(exist_ok=True)
    path.with_suffix(".part").write_text(json.dumps(rows))
    path.with_suffix(".part").replace(path)


def _command(name: str, options: Options) -> str:
    parts = [f"python -m benchmarks {name} -o DIR"]
    parts += ["--data DIR"] if options.data else []
    parts += ["--quick"] if options.quick else []
    parts += [f"--only {','.join(options.only)}"] if options.only else []
    parts += [f"--workers {options.workers}"] if options.workers > 1 else []
    return " ".join(parts)


def _tree() -> str:
    """Return git's hash of the folder of kcgs."""
    folder = Path(kcgs.__file__).parent
    git = partial(subprocess.run, cwd=folder, capture_output=True, text=True, check=False)
    tree, status = git(["git", "rev-parse", "HEAD:./"]), git(["git", "status", "--porcelain", "."])
    if tree.returncode:
        return "not under git"
    return tree.stdout.strip() + (", changed" if status.stdout else "")


def _machine() -> str:
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.is_file() else []
    names = [line.partition(": ")[2] for line in lines if line.startswith("model name")]
    versions = ", ".join(f"{name} {version(name)}" for name in ("torch", "numba", "numpy", "kornia", "onnxruntime"))
    processor = names[0] if names else platform.processor()
    processor = f"{torch.cuda.get_device_name()}; {processor}" if torch.cuda.is_available() else processor
    python = f"Python {platform.python_version()}"
    return f"{processor}, {os.cpu_count()} cores; {python}; kcgs {kcgs.__version__}, {versions}"


def _text(question: str, page: Page, run: dict[str, Any]) -> str:
    parts = [f"# {question}", QUICK_NOTE if run["quick"] else "", run["note"], page.answer]
    parts += [f"![]({page.figure})", page.table, "## Losses", page.losses or "None.", "## How", page.method]
    intervals = f", differences with 95 % intervals: [{DIFFERENCES_FILE}]({DIFFERENCES_FILE})"
    facts = [
        f"- Command: `{run['command']}`",
        f"- Tree of kcgs/: `{run['tree']}`",
        f"- Machine: {run['machine']}",
        f"- Every number: [{RESULTS_FILE}]({RESULTS_FILE}){intervals if page.differences else ''}",
    ]
    parts.append("\n".join(facts))
    return "\n\n".join(filter(None, parts)) + "\n"
