"""What compiled loops have in common: where they are kept, and the one line that says how long they took."""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

log = logging.getLogger("kcgs")
T = TypeVar("T")


def compile_kept(name: str, compiler: Callable[[str, bool], T], sources: Iterable[Path]) -> T:
    """Return the loops that `compiler` makes of a fingerprint of the sources and of whether to keep them on disk.

    Where no folder takes them they are kept in memory, and a warning says so.
    """
    digest = hashlib.sha256()
    for source in sources:
        digest.update(source.read_bytes())
    try:
        return compiler(digest.hexdigest(), True)
    except RuntimeError:  # numba finds no folder that it may write to
        log.warning("kcgs: no folder to keep the compiled %s in; set NUMBA_CACHE_DIR to one", name)
        return compiler(digest.hexdigest(), False)


@contextmanager
def announced(what: str, loops: Any) -> Iterator[None]:
    """Write one line after the first calls of loops: that they were compiled, or loaded from disk, in how long."""
    start, before = time.perf_counter(), _count_compiled(loops)
    yield
    made = _count_compiled(loops) > before
    kept = all(loop.stats.cache_path for loop in loops)
    log.log(
        logging.WARNING if made else logging.INFO,
        "kcgs: %s %s in %.1f s%s",
        "compiled" if made else "loaded",
        what,
        time.perf_counter() - start,
        ", kept on disk for next time" if made and kept else "",
    )


def _count_compiled(loops: Any) -> int:
    return sum(len(loop.overloads) - sum(loop.stats.cache_hits.values()) for loop in loops)
