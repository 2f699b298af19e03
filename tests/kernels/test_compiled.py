"""Compiled loops: where they are kept, and what the log says."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from kcgs.kernels import compiled
from kcgs.kernels.compiled import Program, inner


@inner
def twice(value):  # type: ignore[no-untyped-def]
    return 2 * value


def double_in(cache: Path, monkeypatch: pytest.MonkeyPatch) -> float:
    """Run a loop of a new program, as a new process would."""
    monkeypatch.setattr(compiled._config, "CACHE_DIR", str(cache))

    @Program("doubling", __file__).entry
    def double(values):  # type: ignore[no-untyped-def]
        return twice(values[0])

    return float(double(np.array([1.5])))


def test_compiled_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("INFO", "kcgs"):
        assert [double_in(tmp_path, monkeypatch) for _ in range(2)] == [3.0, 3.0]
    assert caplog.messages == ["kcgs: compiling the doubling, once on this machine"]
    assert len(list(tmp_path.glob("kcgs-*/*.nbc"))) == 1


def test_without_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "file").write_text("")
    assert double_in(tmp_path / "file" / "folder", monkeypatch) == 3.0
    assert caplog.messages == ["kcgs: compiling the doubling; to keep it, set NUMBA_CACHE_DIR to a folder"]


def test_folder_follows_the_text_of_sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two checkouts share what they compile; another source, or processor, has another folder."""
    monkeypatch.setattr(compiled._config, "CACHE_DIR", str(tmp_path / "cache"))
    copy = Path(shutil.copy(__file__, tmp_path / "copy.py"))
    folder = compiled._find_folder("name", [Path(__file__)])
    assert folder is not None and folder.parent == tmp_path / "cache"
    assert folder == compiled._find_folder("name", [copy]) != compiled._find_folder("other", [copy])
    copy.write_text(copy.read_text() + "\n")
    assert folder != compiled._find_folder("name", [copy])
    monkeypatch.setattr(compiled.binding, "get_host_cpu_name", lambda: "other")
    assert folder != compiled._find_folder("name", [Path(__file__)])


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have other places")
@pytest.mark.parametrize("user", [{"XDG_CACHE_HOME": "cache"}, {"HOME": ".", "XDG_CACHE_HOME": ""}])
def test_folder_of_the_user(user: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled._config, "CACHE_DIR", "")
    for name, place in user.items():
        if place:
            monkeypatch.setenv(name, str(tmp_path / place))
        else:
            monkeypatch.delenv(name, raising=False)
    folder = compiled._find_folder("name", [])
    assert folder is not None and folder.is_relative_to(tmp_path)
