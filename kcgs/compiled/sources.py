"""The sources that compiled loops depend on: their file, and what it imports from kcgs at its top.

A name is followed through the `__init__` of a package to the file that defines it.
"""

from __future__ import annotations

import functools
import hashlib
import re
from pathlib import Path

_PACKAGE = Path(__file__).parents[1]
# imports at the top of a source: dots or the package, the rest of a module's name, the names from it; `ast` takes 10
# times as long, and tests/compiled compares what is found with what loops name
_IMPORT = re.compile(r"^from (\.+|kcgs\b)\.?([\w.]*) import (\([^)]*\)|.*)", re.MULTILINE)


@functools.cache
def hash_sources(file: Path) -> list[str]:
    """Return digests of the sources of a file's loops, in an order that does not depend on paths."""
    return sorted(hashlib.sha256(source.read_bytes()).hexdigest() for source in find_sources(file))


def find_sources(file: Path) -> set[Path]:
    """Return a file, the files of kcgs that it imports at its top, directly or not, and tables beside them."""
    sources: set[Path] = set()
    pending = [file]
    while pending:
        source = pending.pop()
        if source not in sources:
            sources.add(source)
            pending += _find_imports(source)
    return sources | {table for folder in {source.parent for source in sources} for table in folder.glob("*.bin")}


@functools.cache
def _find_imports(file: Path) -> list[Path]:
    """Return the files that define what a file imports from kcgs, also where a package re-exports it."""
    return [source for module, names in _read_imports(file) for name in names for source in _find_origin(module, name)]


@functools.cache
def _read_imports(file: Path) -> list[tuple[Path, list[str]]]:
    """Return the modules of kcgs that a file imports from, without a suffix, and names from each."""
    imports = []
    for start, name, members in _IMPORT.findall(file.read_text(encoding="utf-8")):
        folder = file.parents[len(start) - 1] if start.startswith(".") else _PACKAGE
        imports.append((folder.joinpath(*name.split(".")), re.findall(r"\w+", members)))
    return imports


def _find_origin(module: Path, name: str) -> list[Path]:
    """Return the file that defines a name of a module of kcgs; none, if there is no such module."""
    if not module.is_dir():
        return [source] if (source := Path(f"{module}.py")).is_file() else []
    for origin, names in _read_imports(module / "__init__.py"):
        if name in names:
            return _find_origin(origin, name)
    return _find_origin(module / name, name) or [module / "__init__.py"]
