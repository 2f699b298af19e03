"""Progress on a terminal, in a notebook, and elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from kcgs import _progress, fit
from kcgs._progress import Progress
from tests.conftest import Clock

IMAGE = torch.linspace(0.0, 1.0, 48).expand(3, 32, 48)
Work = Callable[..., None]


@pytest.fixture
def work(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> Work:
    """Do nothing for so many seconds of the fake clock, in which the thread of a Progress writes its lines."""

    def work(name: str, seconds: float, **settings: Any) -> None:
        end = clock.seconds + seconds

        def wait(timeout: float) -> bool:
            clock.advance(min(timeout, end - clock.seconds))
            return clock.seconds >= end

        threads = SimpleNamespace(
            Event=lambda: SimpleNamespace(wait=wait, set=lambda: None),
            Thread=lambda target, args, **_: SimpleNamespace(start=lambda: target(*args)),
        )
        monkeypatch.setattr(_progress, "threading", threads)
        with Progress(name, known=False, **settings):
            pass

    monkeypatch.setattr(_progress, "_LINE_SECONDS", 10.0)
    Progress.forget()
    return work


def test_a_line_every_ten_seconds(work: Work, capsys: pytest.CaptureFixture[str]) -> None:
    work("long", 35.0)
    assert capsys.readouterr().err == "kcgs: long, 10 s\nkcgs: long, 20 s\nkcgs: long, 30 s\n"


def test_many_short_pieces_are_long_together(work: Work, capsys: pytest.CaptureFixture[str]) -> None:
    for index in range(8):
        work(f"piece {index}", 4.5)
    assert capsys.readouterr().err == "kcgs: piece 2, 1 s\nkcgs: piece 4, 2 s\nkcgs: piece 6, 3 s\n"


def test_what_was_long_ago_is_not_the_same_work(work: Work, clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    for pause in (lambda: clock.advance(20.0), Progress.forget):
        Progress.forget()
        work("long", 15.0)
        pause()
        work("quick", 9.0)
    assert capsys.readouterr().err == 2 * "kcgs: long, 10 s\n"


def test_not_shown(work: Work, capsys: pytest.CaptureFixture[str]) -> None:
    work("long", 35.0, shown=False)
    assert capsys.readouterr().err == ""


@pytest.mark.usefixtures("clock")
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
