"""Progress on a terminal and elsewhere."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from kcgs import fit
from kcgs._progress import Progress

IMAGE = torch.linspace(0.0, 1.0, 48).expand(3, 32, 48)


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


@pytest.mark.parametrize("is_terminal", [True, False])
def test_nothing_elsewhere_or_where_it_is_not_wanted(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], is_terminal: bool
) -> None:
    monkeypatch.setattr("rich.console.Console.is_terminal", is_terminal)
    with Progress("work", pulse=True, visible=not is_terminal) as progress:
        progress.update(0.5, "halfway")
    assert capsys.readouterr() == ("", "")
