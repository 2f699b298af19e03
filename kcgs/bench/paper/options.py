"""What the four commands are asked."""

from __future__ import annotations

import time
from pathlib import Path
from typing import NamedTuple

from kcgs.bench.fits import HERE, Place

from .trials import Store

PUBLISHED_ITERATIONS = 2_000


class Options(NamedTuple):
    """Options that the paper's experiments share."""

    data: Path | None = None
    quick: bool = False
    place: Place = HERE
    sequences: str | None = None  # names with commas between them; None: all
    budget_seconds: float | None = None  # for fits; None: all are made
    seeds: int = 1
    iterations: int | None = None  # of the published recipes; None: the experiment's own choice
    runs: Path | None = None  # folder of the fits; None: runs, in the output

    def store(self, output: Path) -> Store:
        """Open the folder of the fits."""
        return Store(output / "runs" if self.runs is None else self.runs, self.data)

    def deadline(self) -> float | None:
        """Return the moment when no further fit is to begin, by the monotonic clock; None: never."""
        return None if self.budget_seconds is None else time.monotonic() + self.budget_seconds

    def check(self) -> None:
        """Refuse numbers out of range.

        Raises:
            ValueError: one is.
        """
        for name in ("budget_seconds", "seeds", "iterations"):
            value = getattr(self, name)
            if value is not None and value <= 0:
                raise ValueError(f"{name} must be above 0; got {value}")

    def command(self, name: str) -> str:
        """Write the command, without the folders of whoever ran it."""
        given = {"sequences": self.sequences, "budget-seconds": self.budget_seconds, "iterations": self.iterations}
        parts = [f"kcgs bench {name} -o DIR", "--data DIR" if self.data is not None else ""]
        parts += [f"--{key} {value:g}" if isinstance(value, float) else f"--{key} {value}"
                  for key, value in given.items() if value is not None]  # fmt: skip
        parts += [f"--seeds {self.seeds}" if self.seeds > 1 else "", "--runs DIR" if self.runs is not None else ""]
        return " ".join(part for part in [*parts, "--quick" if self.quick else ""] if part)
