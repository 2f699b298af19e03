"""Progress on a terminal, in a notebook, and elsewhere."""

from __future__ import annotations

import sys
import time
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from kcgs import _progress, fit
from kcgs._progress import Progress

IMAGE = torch.linspace(0.0, 1.0, 48).expand(3, 32, 48)


@pytest.fixture
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have a line every twentieth of a second."""
    monkeypatch.setattr(_progress, "_LINE_SECONDS", 0.05)
    Progress.forget()


def test_lines_elsewhere(often: None, capsys: pytest.CaptureFixture[str]) -> None:
    fit(IMAGE, num_gaussians=8, iterations=60, progress=True, on_step=lambda *_: time.sleep(0.005))
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("kcgs: fit, ")]
    assert len(lines) >= 3
    assert " %, iteration " in lines[-1] and "8 Gaussians, " in lines[-1] and lines[-1].endswith(" s")


def test_many_short_pieces_are_long_together(often: None, capsys: pytest.CaptureFixture[str]) -> None:
    for index in range(10):
        with Progress(f"piece {index}", known=False):
            time.sleep(0.02)
    lines = capsys.readouterr().err.splitlines()
    assert 2 <= len(lines) <= 5 and all(line.startswith("kcgs: piece ") and "%" not in line for line in lines)


def test_what_was_long_ago_is_not_the_same_work(
    often: None, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with Progress("long"):
        time.sleep(0.12)
    monkeypatch.setattr(_progress, "_LINE_SECONDS", 0.2)
    for wait in (time.sleep, lambda _: Progress.forget()):
        wait(0.45)
        with Progress("quick"):
            time.sleep(0.05)
    assert "long" in (err := capsys.readouterr().err) and "quick" not in err


def test_not_shown(often: None, capsys: pytest.CaptureFixture[str]) -> None:
    with Progress("fit", shown=False):
        time.sleep(0.1)
    fit(IMAGE, num_gaussians=8, iterations=3)
    assert "fit" not in capsys.readouterr().err


@pytest.mark.parametrize("settings", [{}, {"target_psnr": 90.0}, {"max_seconds": 5.0}], ids=lambda s: "".join(s))
def test_bar_on_a_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], settings: dict[str, Any]
) -> None:
    monkeypatch.setattr("rich.console.Console.is_terminal", True)
    stopped = fit(IMAGE, num_gaussians=8, iterations=9, progress=True, on_step=lambda i, _: i == 5, **settings)
    assert stopped.stop_reason == "callback"
    err = capsys.readouterr().err
    assert "fit" in err and "Gaussians, " in err and "dB" in err


def test_bar_in_a_notebook(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    shown: list[dict[str, str]] = []
    handle = SimpleNamespace(update=lambda data, raw: shown.append(data))
    ipython = SimpleNamespace(get_ipython=lambda: SimpleNamespace(kernel=object()))
    display = SimpleNamespace(display=lambda data, **_: shown.append(data) or handle)
    monkeypatch.setitem(sys.modules, "IPython", ipython)
    monkeypatch.setitem(sys.modules, "IPython.display", display)
    fit(IMAGE, num_gaussians=8, iterations=4, progress=True)
    assert shown[0]["text/html"].startswith('<progress value="0.000"></progress> fit, 0 %')
    assert shown[-1]["text/plain"].startswith("fit, 100 %, iteration 4, 8 Gaussians, ")
    assert "fit" not in capsys.readouterr().err


def test_more_gaussians_than_pixels_are_refused() -> None:
    with pytest.raises(ValueError, match="num_gaussians must be at most 1536, the pixels of the 48 x 32 image; got 20"):
        fit(IMAGE, num_gaussians=2000)
