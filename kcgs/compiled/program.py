"""Compiled loops: functions that numba compiles on their first call, and that are kept on disk by their sources.

To add one, write in the module that calls it:

1. `program = Program("what the log calls it")`;
2. `@program.entry` above a function that Python calls, with arrays in C order, numbers and named tuples of both;
3. `@inner` above a function that only compiled functions call, `@inline` where it is small and called often,
   `@inline_once` where it is large and called once.

If the text of the module changes, or of a module of kcgs that it imports at its top, its functions are compiled anew.
"""

from __future__ import annotations

import functools
import hashlib
import logging
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, cast

import llvmlite
import numba

from kcgs._atomic import write_file
from kcgs._numba_internals import AppDirs, NullCache, config, from_bytes, set_cache, to_bytes

from .sources import hash_sources

log = logging.getLogger("kcgs")
_config: Any = config

_DIGEST_BYTES = hashlib.sha256().digest_size

# for functions that Python does not call: without entry points they compile in less time
inner = cast(Any, numba.njit)(no_cpython_wrapper=True, no_cfunc_wrapper=True, error_model="numpy")
# as `inner`, but every caller has a copy
inline = cast(Any, numba.njit)(no_cpython_wrapper=True, no_cfunc_wrapper=True, error_model="numpy", forceinline=True)

# for a function with one caller: it is compiled once, as part of its caller, and not by itself before
inline_once = cast(Any, numba.njit)(
    no_cpython_wrapper=True, no_cfunc_wrapper=True, error_model="numpy", inline="always"
)


class Program:
    """The compiled loops of one purpose."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._is_announced = False

    def entry(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Decorate a function that Python calls."""
        dispatcher: Any = cast(Any, numba.njit)(nogil=True, no_cfunc_wrapper=True, error_model="numpy")(function)
        set_cache(dispatcher, _Cache(function, self))
        return cast(Callable[..., Any], dispatcher)

    @functools.cached_property
    def folder(self) -> Path | None:
        """The folder of the compiled code; None: no folder can be written."""
        return _find_folder()

    def announce(self) -> None:
        """Log, once, that a compilation begins, which takes seconds."""
        if not self._is_announced:
            self._is_announced = True
            if self.folder is None:
                log.warning("kcgs: compiling the %s; to keep it, set NUMBA_CACHE_DIR to a folder", self._name)
            else:
                log.info("kcgs: compiling the %s, once on this machine", self._name)


class _Cache(NullCache):
    """The compiled code of a function on disk: for each signature a file of a SHA-256, then the pickle it belongs to.

    numba's own cache sees a change of one source only, and hands damaged code to LLVM, which may abort the process.
    """

    def __init__(self, function: Callable[..., Any], program: Program) -> None:
        assert function.__closure__ is None, "the values of a closure are not part of the key"
        self._program = program
        self._name = function.__name__
        versions = sys.implementation.cache_tag, numba.__version__, llvmlite.__version__
        sources = hash_sources(Path(function.__code__.co_filename))
        self._key = function.__module__, function.__qualname__, sources, *versions

    def load_overload(self, signature: Any, context: Any) -> Any:
        context.refresh()
        path = self._path(signature, context.codegen())
        content = None if path is None else _read_compiled(path)
        if content is None:
            self._program.announce()
            return None
        return from_bytes(context, content)

    def save_overload(self, signature: Any, result: Any) -> None:
        path = self._path(signature, result.codegen)
        if path is None:
            return
        assert not result.library.has_dynamic_globals, "an address, of a large global array, is for one process"
        content = to_bytes(result)
        try:
            write_file(path, hashlib.sha256(content).digest() + content)
        except OSError as error:
            reason = error.strerror or error
            _warn_once(f"kcgs: cannot write into {path.parent} ({reason}): what is compiled now is not kept")

    def _path(self, signature: Any, codegen: Any) -> Path | None:
        """Return the file for a signature and a processor."""
        if self._program.folder is None:
            return None
        key = hashlib.sha256(repr((self._key, codegen.magic_tuple(), signature)).encode()).hexdigest()
        return self._program.folder / f"kcgs-{self._name}-{key[:16]}.nbc"


def _read_compiled(path: Path) -> bytes | None:
    """Return the pickle in a file; None if there is no file, or it is damaged."""
    try:
        data = path.read_bytes()
    except OSError:  # `save_overload` warns if the file cannot be replaced either
        return None
    digest, content = data[:_DIGEST_BYTES], data[_DIGEST_BYTES:]
    if hashlib.sha256(content).digest() == digest:
        return content
    _warn_once(f"kcgs: {path.parent} has damaged files: their loops are compiled anew, and the files replaced")
    return None


def _find_folder() -> Path | None:
    """Return the first folder that can be written; None: no folder can."""
    user = AppDirs(appname="kcgs", appauthor=False).user_cache_dir
    folders = [_config.CACHE_DIR] if _config.CACHE_DIR else [user, Path(__file__).parent / "__pycache__"]
    for folder in map(Path, folders):
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
            return folder
    return None


@functools.cache
def _warn_once(message: str) -> None:
    log.warning(message)
