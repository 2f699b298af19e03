"""Compiled loops: functions that numba compiles when they are first called, and keeps on disk by the text of sources.

To add one, write in the module that calls it:

1. `program = Program("what the log calls it", __file__)`, with the names of the other files that its loops come from;
2. `@program.entry` above a function that Python calls, with arrays in C order, numbers and named tuples of both;
3. `@inner` above a function that only compiled functions call, `@inline` where it is small and called often,
   `@part` where it is large and called once.
"""

from __future__ import annotations

import hashlib
import logging
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, cast

import llvmlite
import numba
from llvmlite import binding
from numba.core import caching, config
from numba.misc.appdirs import AppDirs

log = logging.getLogger("kcgs")
_config: Any = config

# without entry points for Python functions compile in less time
inner = cast(Any, numba.njit)(no_cpython_wrapper=True, no_cfunc_wrapper=True, error_model="numpy")
# the same, of which every caller has a copy
inline = cast(Any, numba.njit)(no_cpython_wrapper=True, no_cfunc_wrapper=True, error_model="numpy", forceinline=True)

# of one caller, and part of its code from the first: compiled once, not alone and then again with it
part = cast(Any, numba.njit)(no_cpython_wrapper=True, no_cfunc_wrapper=True, error_model="numpy", inline="always")


class Program:
    """The compiled loops of some source files: `file`, and `others` beside it."""

    def __init__(self, name: str, file: str, *others: str) -> None:
        self._name = name
        self._folder = _find_folder(name, [Path(file), *(Path(file).parent / other for other in others)])
        self._is_announced = False

    def entry(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Decorate a function that Python calls."""
        dispatcher: Any = cast(Any, numba.njit)(nogil=True, no_cfunc_wrapper=True, error_model="numpy")(function)
        dispatcher._cache = _make_cache(function, self._folder, self._announce)
        return cast(Callable[..., Any], dispatcher)

    def _announce(self) -> None:
        """Log, once, that a compilation begins, which takes seconds."""
        if not self._is_announced:
            self._is_announced = True
            if self._folder is None:
                log.warning("kcgs: compiling the %s; to keep it, set NUMBA_CACHE_DIR to a folder", self._name)
            else:
                log.info("kcgs: compiling the %s, once on this machine", self._name)


def _find_folder(name: str, sources: Sequence[Path]) -> Path | None:
    """Return the folder for what a program compiles to with this Python, numba and processor; None: there is none.

    numba's own choice goes by the path of the sources, and looks at one file to tell whether they have changed.
    """
    processor = binding.get_host_cpu_name(), binding.get_host_cpu_features().flatten()
    versions = sys.implementation.cache_tag, numba.__version__, llvmlite.__version__
    digest = hashlib.sha256(repr((name, *versions, *processor)).encode())
    for source in (Path(__file__), *sources):
        digest.update(source.read_bytes())
    user = AppDirs(appname="kcgs", appauthor=False).user_cache_dir
    for base in [_config.CACHE_DIR] if _config.CACHE_DIR else [user, Path(__file__).parent / "__pycache__"]:
        folder = Path(base) / f"kcgs-{digest.hexdigest()[:16]}"
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
            return folder
    return None


def _make_cache(function: Callable[..., Any], folder: Path | None, announce: Callable[[], None]) -> Any:
    """Return numba's cache of a function; it calls `announce` where it does not hold what is asked for."""

    class Locator(caching._CacheLocator):
        _py_file = function.__code__.co_filename

        @classmethod
        def from_function(cls, *_: Any) -> Locator:
            return cls()

        def get_cache_path(self) -> str:
            return str(folder)

        def get_source_stamp(self) -> str:
            return ""  # a folder is of one text of the sources

        def get_disambiguator(self) -> str:
            return "0"

    class Implementation(caching.CompileResultCacheImpl):
        _locator_classes: Any = (Locator,)

    class Cache(caching.FunctionCache):
        _impl_class = Implementation

        def load_overload(self, signature: Any, context: Any) -> Any:
            overload = super().load_overload(signature, context)  # type: ignore[no-untyped-call]
            if overload is None:
                announce()
            return overload

    cache: Any = cast(Any, Cache)(function)
    if folder is None:
        cache.disable()
    return cache
