"""What happens to a fit besides the descent: each strategy says when it is due, and changes the state.

Thresholds are fields of the strategies' classes; what they count is in the state, which is handed in.
"""

from __future__ import annotations

from typing import Protocol

from kcgs.fit.config import FitConfig
from kcgs.fit.state import FitState

from .densify import Densify, DensifyAtLargestError
from .drafts import EndDrafts
from .finish import Finish
from .merge_regions import MergeRegions
from .move_contours import MoveContours
from .warmup import RefreshIds

__all__ = [
    "Densify",
    "DensifyAtLargestError",
    "EndDrafts",
    "Finish",
    "MergeRegions",
    "MoveContours",
    "RefreshIds",
    "Strategy",
    "make_strategies",
]


class Strategy(Protocol):
    """Something that happens to a fit from time to time."""

    def due(self, progress: float, state: FitState) -> bool:
        """Say whether it is time, when this share of the fit is done."""

    def apply(self, state: FitState) -> None:
        """Change the state."""


def make_strategies(config: FitConfig) -> list[Strategy]:
    """Return the strategies that the settings ask for, in the order in which an iteration asks them."""
    strategies: list[Strategy] = [EndDrafts()]
    if config.warmup:
        strategies.append(RefreshIds())
    kind = DensifyAtLargestError if config.densify == "largest-error" else Densify
    contours = MoveContours(rise=config.contour_rise, after=kind.end) if config.move_contours else None
    strategies.append(kind(contours))
    if contours is not None:
        strategies.append(contours)
    if config.merge_regions:
        strategies.append(MergeRegions(after=kind.end))
    return strategies
