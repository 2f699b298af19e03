"""What was measured."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from .scenes import Scene


class Row(NamedTuple):
    """One measured number."""

    section: str
    scene: str
    size: str
    decoder: str
    threads: int
    cutoff: float
    quantity: str
    value: float
    unit: str


class Findings(NamedTuple):
    """All that a report is made of."""

    rows: list[Row]
    scenes: list[Scene]
    left_out: Mapping[str, list[str]]  # by scene; of the generic decoder by its name
    missing: str | None  # why nothing was fitted
    quick: bool

    def value(
        self,
        section: str,
        scene: str,
        size: str,
        decoder: str,
        quantity: str,
        *,
        threads: int = 1,
        cutoff: float = 1e-4,
    ) -> float | None:
        """One number, or None where it was not measured."""
        for r in self.rows:
            found = (r.section, r.scene, r.size, r.decoder, r.threads, r.cutoff, r.quantity)
            if found == (section, scene, size, decoder, threads, cutoff, quantity):
                return r.value
        return None

    def names(self, section: str, field: str) -> list[Any]:
        """Scenes, sizes, decoders or cutoffs of a section, in order."""
        return list(dict.fromkeys(getattr(r, field) for r in self.rows if r.section == section))


def cutoff_name(value: float) -> str:
    """Write a cutoff as people do."""
    return "1/255" if value == 1 / 255 else f"{value:.0e}".replace("e-0", "e-")
