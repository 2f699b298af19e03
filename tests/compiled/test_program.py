"""Compiled loops: what their files on disk follow from, damaged files, and what the log says."""

from __future__ import annotations

import ast
import errno
import inspect
import os
import sys
from collections.abc import Callable
from importlib import import_module
from importlib.util import resolve_name
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any, NoReturn

import numpy as np
import pytest

import kcgs
from kcgs.compiled import program, sources
from kcgs.compiled.program import Program, inner

ROOT = Path(kcgs.__file__).parent
LOOPS = """
from kcgs.compiled.program import Program

from .constants import FACTOR


@Program("scaling").entry
def scale(values):
    return FACTOR * values[0]
"""


@inner
def twice(value):  # type: ignore[no-untyped-def]
    return 2 * value


def double_in(cache: Path, monkeypatch: pytest.MonkeyPatch) -> float:
    """Run a loop of a new program, as a new process would."""
    monkeypatch.setattr(program._config, "CACHE_DIR", str(cache))

    @Program("doubling").entry
    def double(values):  # type: ignore[no-untyped-def]
        return twice(values[0])

    return float(double(np.array([1.5])))


def make_scaling(folder: Path, factor: float) -> Path:
    """Write a package whose loop takes a constant from another module."""
    package = folder / "scaling"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "constants.py").write_text(f"FACTOR = {factor}\n")
    (package / "loops.py").write_text(LOOPS)
    return folder


def test_compiled_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("INFO", "kcgs"):
        assert [double_in(tmp_path, monkeypatch) for _ in range(2)] == [3.0, 3.0]
    assert caplog.messages == ["kcgs: compiling the doubling, once on this machine"]
    assert len(list(tmp_path.rglob("*.nbc"))) == 1
    monkeypatch.setattr(program._config, "CPU_NAME", "other")
    assert double_in(tmp_path, monkeypatch) == 3.0 and len(list(tmp_path.rglob("*.nbc"))) == 2


def test_without_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "file").write_text("")
    assert double_in(tmp_path / "file" / "folder", monkeypatch) == 3.0
    assert caplog.messages == ["kcgs: compiling the doubling; to keep it, set NUMBA_CACHE_DIR to a folder"]


def flip_a_bit(file: Path) -> None:
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)


def replace_by_a_folder(file: Path) -> None:
    file.unlink()
    file.mkdir()


@pytest.mark.parametrize(
    "damage",
    [
        pytest.param(lambda file: file.write_bytes(b""), id="empty"),
        flip_a_bit,
        replace_by_a_folder,
    ],
)
def test_damaged_files(
    damage: Callable[[Path], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Damaged code must not reach LLVM, which ends the process."""
    double_in(tmp_path, monkeypatch)
    caplog.clear()
    for file in list(tmp_path.rglob("*.nb?")):
        damage(file)
    with caplog.at_level("WARNING", "kcgs"):
        assert [double_in(tmp_path, monkeypatch) for _ in range(2)] == [3.0, 3.0]
    assert len(caplog.messages) == 1 and str(tmp_path) in caplog.text


def test_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    def fail(*_: object) -> NoReturn:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "replace", fail)
    with caplog.at_level("WARNING", "kcgs"):
        assert [double_in(tmp_path, monkeypatch) for _ in range(2)] == [3.0, 3.0]
    reason = "(No space left on device): what is compiled now is not kept"
    assert caplog.messages == [f"kcgs: cannot write into {tmp_path} {reason}"]
    assert not list(tmp_path.rglob("*.nb*"))


def test_constant_of_another_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two checkouts share what they compile, unless a module differs that the loop takes a constant from."""
    monkeypatch.setattr(program._config, "CACHE_DIR", str(tmp_path / "cache"))
    for name, factor, num_files in (("first", 2.0, 1), ("second", 2.0, 1), ("third", 3.0, 2)):
        with monkeypatch.context() as patch:
            patch.syspath_prepend(make_scaling(tmp_path / name, factor))
            assert import_module("scaling.loops").scale(np.ones(1)) == factor
        for module in ("scaling", "scaling.constants", "scaling.loops"):
            del sys.modules[module]
        assert len(list((tmp_path / "cache").rglob("*.nbc"))) == num_files


def global_names(code: CodeType) -> set[str]:
    """Return the names of globals, and of attributes, in the code of a function and of the functions within it."""
    return set(code.co_names).union(*(global_names(part) for part in code.co_consts if isinstance(part, CodeType)))


def find_origins(module: str) -> dict[str, str]:
    """Return the modules that a module imports names from; where a room of kcgs does so, too, those."""
    origins: dict[str, str] = {}
    for node in ast.walk(ast.parse(inspect.getsource(sys.modules[module]))):
        if isinstance(node, ast.ImportFrom):
            source = resolve_name("." * node.level + (node.module or ""), sys.modules[module].__package__)
            is_door = source.startswith("kcgs.") and hasattr(sys.modules[source], "__path__")
            inner = find_origins(source) if is_door else {}
            origins |= {alias.asname or alias.name: inner.get(alias.name, source) for alias in node.names}
    return origins


def find_modules(loop: Any) -> set[str]:
    """Return the modules of kcgs that a loop, and the functions and classes that it uses, take names from."""
    modules: set[str] = set()
    pending, visited = [loop], set()
    while pending:
        value = pending.pop()
        value = getattr(value, "py_func", getattr(value, "_defn", value))  # of compiled functions, and of intrinsics
        if id(value) in visited or not str(getattr(value, "__module__", "")).startswith("kcgs."):
            continue
        visited.add(id(value))
        if isinstance(value, type):
            pending += vars(value).values()
        if isinstance(value, FunctionType):
            origins = find_origins(value.__module__)
            names = global_names(value.__code__) & value.__globals__.keys()
            pending += [value.__globals__[name] for name in names]
            pending += [cell.cell_contents for cell in value.__closure__ or ()]
            modules |= {value.__module__, *(origins.get(name, value.__module__) for name in names)}
    return {module for module in modules if module.startswith("kcgs.")}


@pytest.mark.parametrize(
    "file",
    sorted(file.relative_to(ROOT) for file in ROOT.rglob("*.py") if "\n@program.entry\n" in file.read_text("utf-8")),
    ids=str,
)
def test_sources_hold_all_that_loops_name(file: Path) -> None:
    module = import_module(".".join(("kcgs", *file.with_suffix("").parts)))
    loops = [value for value in vars(module).values() if isinstance(getattr(value, "_cache", None), program._Cache)]
    modules = set().union(*map(find_modules, loops))
    assert module.__name__ in modules
    assert {Path(str(sys.modules[name].__file__)) for name in modules} <= sources.find_sources(ROOT / file)


@pytest.mark.parametrize(
    ("file", "source"),
    [
        ("optim/ms_ssim_loops.py", "functional/similarity.py"),
        ("codec/labels/wavefront.py", "codec/labels/scene_prior.bin"),
        ("kernels/cpu/loops.py", "kernels/cpu/channels.py"),
    ],
)
def test_sources_that_no_loop_is_in(file: str, source: str) -> None:
    found = sources.find_sources(ROOT / file)
    assert ROOT / source in found
    assert all(path.is_relative_to(ROOT) for path in found) and len(found) < 40  # not all of kcgs, nor of others


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have other places")
@pytest.mark.parametrize("user", [{"XDG_CACHE_HOME": "cache"}, {"HOME": ".", "XDG_CACHE_HOME": ""}])
def test_folder_of_the_user(user: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(program._config, "CACHE_DIR", "")
    for name, place in user.items():
        if place:
            monkeypatch.setenv(name, str(tmp_path / place))
        else:
            monkeypatch.delenv(name, raising=False)
    folder = program._find_folder()
    assert folder is not None and folder.is_relative_to(tmp_path)
