"""Loops that are compiled in other processes and kept on disk: by their text, and whatever becomes of the processes."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kcgs.kernels import compiled
from kcgs.kernels.compiled import Program


def make(folder: Path | None, module: str = "kcgs.nowhere") -> Program:
    """Make a program of one loop; processes that compile it do not find its module."""
    program = Program("test", module, __file__)
    program._folder = folder

    @program.entry
    def double(values):  # type: ignore[no-untyped-def]
        values[0] = 2 * values[0]

    @program.part
    def rehearsal() -> None:
        double(np.ones(1))

    return program


@pytest.fixture
def cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled, "_CORES", 2)


@pytest.mark.usefixtures("cores")
class TestProgram:
    def test_processes_that_die_do_no_harm_and_are_gone(self, tmp_path: Path) -> None:
        program = make(tmp_path)
        program.start()
        program.ready()
        (worker,) = program._workers or []
        assert not worker.is_alive()
        assert worker._process is not None and worker._process.returncode != 0
        assert len(list(tmp_path.glob("*.nbc"))) == 1  # compiled here

    def test_where_processes_are_forbidden(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def refuse(*_: Any, **__: Any) -> None:
            raise PermissionError

        monkeypatch.setattr(subprocess, "Popen", refuse)
        make(tmp_path).ready()
        assert len(list(tmp_path.glob("*.nbc"))) == 1

    def test_what_is_kept_needs_no_process(self, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
        make(tmp_path).ready()
        caplog.clear()
        again = make(tmp_path)
        with caplog.at_level("INFO", "kcgs"):
            again.ready()
        assert again._workers == [] and not caplog.records

    @pytest.mark.parametrize("executable", [None, "", "/usr/bin/uwsgi"])
    def test_no_process_but_of_an_interpreter(
        self, executable: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(sys, "executable", executable)
        program = make(tmp_path)
        program.start()
        assert program._workers == []


def test_folder_goes_by_the_text_not_by_the_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two checkouts share what they compile; a change of any source, or of the processor, makes it anew."""
    monkeypatch.setattr(compiled._config, "CACHE_DIR", str(tmp_path / "cache"))
    source = Path(compiled.__file__).parent / "cpu" / "simd.py"
    copy = Path(shutil.copy(source, tmp_path / "other.py"))
    folder = compiled._find_folder("module", [source])
    assert folder is not None and folder.parent == tmp_path / "cache"
    assert folder == compiled._find_folder("module", [copy]) != compiled._find_folder("other", [source])
    copy.write_text(copy.read_text() + "\n")
    assert folder != compiled._find_folder("module", [copy])
    monkeypatch.setattr(compiled.binding, "get_host_cpu_name", lambda: "other")
    assert folder != compiled._find_folder("module", [source])


@pytest.mark.parametrize("user", [{"XDG_CACHE_HOME": "cache"}, {"HOME": ".", "XDG_CACHE_HOME": ""}])
def test_folder_is_the_user_s(user: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if sys.platform != "linux":
        pytest.skip("other systems have other places")
    monkeypatch.setattr(compiled._config, "CACHE_DIR", "")
    for name, place in user.items():
        monkeypatch.setenv(name, str(tmp_path / place) if place else "")
        if not place:
            monkeypatch.delenv(name)
    folder = compiled._find_folder("module", [])
    assert folder is not None and folder.is_relative_to(tmp_path)


@pytest.mark.parametrize(
    ("module", "part", "count"), [("kcgs.kernels.cpu.loops", "lists", 3), ("kcgs.codec.labels.wavefront", "places", 2)]
)
def test_processes_that_compile_do_without_torch(module: str, part: str, count: int, tmp_path: Path) -> None:
    python, option, code, *rest = compiled._Worker(module, part)._command
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "NUMBA_OPT": "1"}
    code += "assert 'torch' not in sys.modules and len(sys.modules) > 100"
    subprocess.run([python, option, code, *rest], check=True, env=environment)
    assert len(list(tmp_path.glob("*/*.nbc"))) == count
