"""A report: what is written of results, below how and where they were made.

Results are files in the report's folder (results.csv), and so is how they were made (made.json). A report is written
from these files alone, when it is made and whenever it is made again.
"""

from __future__ import annotations

import json
import os
import platform
import shutil
from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple

from kcgs._atomic import write_file

from .eye import PROGRAM

_PACKAGES = ("kcgs", "torch", "numba", "numpy", "kornia", "triton", "ssimulacra2")
QUICK_TEXT = "The short form, small images and few iterations: the numbers only show that all of it runs."


class Made(NamedTuple):
    """How results were made."""

    command: str
    quick: bool = False
    machine: tuple[str, ...] = ()  # lines below the command: processor, versions, where fits ran
    notes: tuple[str, ...] = ()  # what a reader must know of this run: what is missing, and why


# from the folder of the results to the report's parts, the title first
Report = Callable[[Path, Made], Sequence[str]]


def conclude(report: Report, output: Path, made: Made) -> None:
    """Write down how results were made, on this machine, and their report."""
    made = made._replace(machine=(*describe(), *made.machine))
    write_file(output / "made.json", json.dumps(made._asdict(), indent=1) + "\n")
    redraw(report, output)


def redraw(report: Report, output: Path) -> None:
    """Write report.md and its figures from the files of an earlier run; a FileNotFoundError where there was none."""
    fields = json.loads((output / "made.json").read_text(encoding="utf-8"))
    made = Made(**{**fields, "machine": tuple(fields["machine"]), "notes": tuple(fields["notes"])})
    title, *parts = report(output, made)
    head = [title, f"Made by `{made.command}`.", _listed(made.machine), QUICK_TEXT if made.quick else ""]
    write_file(output / "report.md", "\n\n".join(filter(None, [*head, _listed(made.notes), *parts])) + "\n")


def _listed(lines: Sequence[str]) -> str:
    return "\n".join(f"- {line}" for line in lines)


def describe() -> list[str]:
    """Lines for a report: processor, cores, memory, versions."""
    where = f"{platform.system()} {platform.machine()}"
    versions = ", ".join(f"{name} {_version(name)}" for name in _PACKAGES)
    return [
        f"Processor: {_processor()}, {os.cpu_count()} cores, {_memory()}; {where}",
        f"Python {platform.python_version()}; {versions}, {PROGRAM} {'' if shutil.which(PROGRAM) else 'not '}installed",
    ]


def _processor() -> str:
    path = Path("/proc/cpuinfo")
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    names = [line.partition(": ")[2] for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or "unknown"


def _memory() -> str:
    try:
        return f"{os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 2**30:.0f} GiB"
    except (AttributeError, ValueError, OSError):
        return "unknown memory"


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"
