"""Fixtures of tests of commands."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from typing import NamedTuple

import pytest
import torch

from kcgs.cli import main
from kcgs.data import save_image, save_labels


class Run(NamedTuple):
    """A command that was run in this process."""

    code: int
    out: str
    err: str


Kcgs = Callable[..., Run]


@pytest.fixture(autouse=True)
def _ctrl_c() -> Iterator[None]:
    """Have Ctrl-C raise, also where the tests run in the background, in which a shell has it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def kcgs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Kcgs:
    """Run a command as a user does; a message of wrong usage takes one line."""
    monkeypatch.setenv("COLUMNS", "250")

    def run(*arguments: object) -> Run:
        monkeypatch.setattr(sys, "argv", ["kcgs", *map(str, arguments)])
        with pytest.raises(SystemExit) as stop:
            main()
        captured = capsys.readouterr()
        return Run(int(stop.value.code or 0), captured.out, captured.err)

    return run


@pytest.fixture
def photo(tmp_path: object, monkeypatch: pytest.MonkeyPatch) -> None:
    """Work in a folder with photo.png, an orange square on grey, and mask.png, its label map; 40 x 60 pixels."""
    monkeypatch.chdir(str(tmp_path))
    labels = torch.zeros(40, 60, dtype=torch.long)
    labels[10:30, 20:45] = 1
    save_image("photo.png", torch.where(labels.bool(), torch.tensor([0.9, 0.4, 0.1])[:, None, None], 0.3))
    save_labels("mask.png", labels)
