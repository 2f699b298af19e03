"""Loops that numba compiles: once for each machine and user, in processes of their own, ahead where there is time."""

from __future__ import annotations

import atexit
import hashlib
import logging
import os
import subprocess
import sys
import tempfile
import threading
import time
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

_ROOT = Path(__file__).resolve().parent.parent
_CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
_ROOM = threading.Semaphore(min(_CORES, 4))  # for processes that compile
_PATIENCE = 120.0  # seconds after which a process that compiles is given up
# the packages are not run: they would import torch, which takes longer than the compilation
_CHILD = """
import gc, importlib.util, os, sys
root, module, part, *packages = sys.argv[1:]
gc.disable()
for package in packages:
    folder = os.path.join(root, *package.split(".")[1:])
    init = os.path.join(folder, "__init__.py")
    spec = importlib.util.spec_from_file_location(package, init, submodule_search_locations=[folder])
    sys.modules[package] = importlib.util.module_from_spec(spec)
importlib.import_module(module).program.parts[part]()
"""

# of functions that compiled code alone calls: without entry points for Python they compile in less time
inner = cast(Any, numba.njit)(no_cpython_wrapper=True, no_cfunc_wrapper=True, error_model="numpy")


class Program:
    """The loops of a module, compiled together and kept on disk by its name and the text of `sources`, beside `file`.

    The module must not need torch and have its Program under the name `program`. A function under `@program.entry` is
    called from Python. One under `@program.part` calls entries once, with arguments of the types that they are called
    with, for it is then that numba compiles: parts may do so at the same time, each in a process of its own.
    """

    def __init__(self, what: str, module: str, file: str, *sources: str) -> None:
        self._what, self._module = what, module
        self._folder = _find_folder(module, [Path(file).parent / source for source in sources])
        self._entries: list[Any] = []
        self.parts: dict[str, Callable[[], None]] = {}
        self._workers: list[_Worker] | None = None
        self._is_ready = False
        self._lock = threading.Lock()

    def entry(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Decorate a function that Python calls."""
        made: Any = cast(Any, numba.njit)(nogil=True, no_cfunc_wrapper=True, error_model="numpy")(function)
        if self._folder is not None:
            made._cache = _make_cache(function, self._folder)
        self._entries.append(made)
        return cast(Callable[..., Any], made)

    def part(self, rehearsal: Callable[[], None]) -> None:
        """Decorate a function that calls entries once."""
        self.parts[rehearsal.__name__] = rehearsal

    def start(self) -> Program:
        """Begin to compile in other processes what is not on disk yet; return at once."""
        if self._workers is not None:
            return self
        self._workers = []
        # not an application with an interpreter inside: who knows what that would do
        is_python = Path(sys.executable or "").stem.startswith("python") and not hasattr(sys, "frozen")
        if self._folder is None or _CORES == 1 or not is_python:
            return self
        if not all(any(self._folder.glob(f"*.{entry.__name__}-*.nbc")) for entry in self._entries):
            self._workers = [_Worker(self._module, part) for part in self.parts]
        for worker in self._workers:
            worker.start()
        return self

    def wait(self) -> None:
        """Wait for what was started."""
        for worker in self._workers or ():
            worker.join(_PATIENCE)
            worker.stop()

    def ready(self) -> None:
        """Compile or load all loops, unless that has been done; one line says how long a compilation took."""
        if self._is_ready:  # without the lock, which a fork may copy while another thread holds it
            return
        with self._lock:
            if self._is_ready:
                return
            start = time.perf_counter()
            self.start().wait()
            for rehearsal in self.parts.values():
                rehearsal()
            kept = ", kept on disk for next time"
            if self._folder is None:
                log.warning("kcgs: no folder to keep the compiled %s in; set NUMBA_CACHE_DIR to one", self._what)
                kept = ""
            if self._workers or not all(entry.stats.cache_hits for entry in self._entries):
                log.info("kcgs: compiled the %s in %.1f s%s", self._what, time.perf_counter() - start, kept)
            self._is_ready = True


class _Worker(threading.Thread):
    """A process that compiles a part, and the thread that waits for it, so that none is left as a zombie."""

    def __init__(self, module: str, part: str) -> None:
        super().__init__(daemon=True, name="kcgs-compile")
        names = module.split(".")[:-1]
        packages = {__package__, *(".".join(names[: count + 1]) for count in range(len(names)))}
        self._command = [sys.executable, "-c", _CHILD, str(_ROOT), module, part, *sorted(packages)]
        self._process: subprocess.Popen[bytes] | None = None

    def run(self) -> None:
        """Start the process as soon as there is room, and wait for it."""
        quiet: Any = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
        settings = {"PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "NUMBA_CACHE_DIR": _config.CACHE_DIR}
        # where processes are forbidden, whoever needs the loops compiles them
        with _ROOM, suppress(OSError):
            self._process = subprocess.Popen(self._command, env={**os.environ, **settings}, **quiet)
            atexit.register(self.stop)
            self._process.wait()
            atexit.unregister(self.stop)

    def stop(self) -> None:
        """End the process, if it still runs."""
        if self._process is not None:
            self._process.kill()


def _find_folder(module: str, sources: Sequence[Path]) -> Path | None:
    """Return the folder for what a module compiles to with this Python, numba and processor; None: there is none.

    numba's own choice goes by the path of the sources, and looks at one file to tell whether they have changed.
    """
    processor = binding.get_host_cpu_name(), binding.get_host_cpu_features().flatten()
    known = module, sys.implementation.cache_tag, numba.__version__, llvmlite.__version__, *processor
    digest = hashlib.sha256(repr(known).encode())
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


def _make_cache(function: Callable[..., Any], folder: Path) -> Any:
    """Return numba's cache of a function, in a folder that says all that numba would ask of the sources."""
    answers = {
        "get_cache_path": lambda self: str(folder),
        "get_source_stamp": lambda self: folder.name,
        "get_disambiguator": lambda self: "0",
        "from_function": classmethod(lambda cls, *_: cls()),
        "_py_file": function.__code__.co_filename,
    }
    locator = type("Locator", (caching._CacheLocator,), answers)
    implementation = type("Implementation", (caching.CompileResultCacheImpl,), {"_locator_classes": [locator]})
    return type("Cache", (caching.FunctionCache,), {"_impl_class": implementation})(function)
