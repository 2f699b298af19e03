"""The options of an experiment."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from .jobs import Place
from .report import Made


class Options(NamedTuple):
    """Options of all experiments; each says which it takes."""

    data: Path | None = None
    quick: bool = False
    only: str | None = None  # names of groups with commas between them; None: all
    engine: str = "local"
    workers: int | None = None
    sequences: str | None = None  # names with commas between them; None: all
    budget_seconds: float | None = None  # for fits; None: all are made
    seeds: int = 1
    iterations: int | None = None  # of the published recipes; None: the experiment's choice
    runs: Path | None = None  # folder of the fits; None: runs, in the output

    @property
    def place(self) -> Place:
        """Where fits are made."""
        return Place(self.engine, self.workers)

    def deadline(self, share: float = 1.0) -> float | None:
        """Return when a share of the budget is over, by the monotonic clock; None: never."""
        return None if self.budget_seconds is None else time.monotonic() + share * self.budget_seconds

    def check(self) -> None:
        """Refuse numbers out of range with a ValueError."""
        for name in ("budget_seconds", "seeds", "iterations"):
            value = getattr(self, name)
            if value is not None and value <= 0:
                raise ValueError(f"{name} must be above 0; got {value}")

    def command(self, name: str) -> str:
        """Write the command of an experiment, without the folders of whoever ran it."""
        parts = [f"python -m benchmarks {name} -o DIR"]
        for field, value in self._asdict().items():
            if value != self._field_defaults[field]:
                shown = "" if value is True else " DIR" if isinstance(value, Path) else f" {value}"
                parts.append(f"--{field.replace('_', '-')}{shown}")
        return " ".join(parts)

    def made(self, name: str, notes: Sequence[str] = ()) -> Made:
        """Say how an experiment's results are made with these options."""
        return Made(self.command(name), self.quick, (f"Fits: {self.place}",), tuple(notes))
