"""The machine that a report was made on."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path


def describe() -> list[str]:
    """Lines for a report: processor, cores, memory, versions."""
    lines = [
        f"Processor: {_processor()}, {os.cpu_count()} cores, {_memory()}; {platform.system()} {platform.machine()}"
    ]
    names = ("kcgs", "torch", "numba", "numpy", "kornia", "triton")
    lines.append(f"Python {platform.python_version()}; " + ", ".join(f"{n} {_version(n)}" for n in names))
    return lines


def _processor() -> str:
    information = Path("/proc/cpuinfo")
    if information.is_file():
        for line in information.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or "unknown"


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
