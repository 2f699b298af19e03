"""What happens to a fit besides the descent: each strategy says when it is due, and changes the state.

Thresholds are fields of the strategies' classes; what they count is in the state, which they are made for.
"""

from __future__ import annotations

from typing import Protocol

from kcgs.fitting.state import FitState

from .densify import Densify, DensifyAtLargestError
from .finish import EndDrafts, finish
from .move_contours import MoveContours
from .warmup import RefreshIds

__all__ = ["Densify", "MoveContours", "Strategy", "finish", "make_strategies"]


class Strategy(Protocol):
    """Something that happens to a fit from time to time."""

    def due(self, progress: float) -> bool:
        """Say whether it is time, when this share of the fit is done."""

    def apply(self, state: FitState) -> None:
        """Change the state."""


def make_strategies(state: FitState) -> list[Strategy]:
    """Return the strategies that a fit's settings ask for, in the order in which an iteration asks them."""
    config = state.config
    strategies: list[Strategy] = [EndDrafts()]
    if config.warmup:
        strategies.append(RefreshIds(state))
    kind = DensifyAtLargestError if config.densify == "largest-error" else Densify
    contours = MoveContours(state, kind.end) if config.move_contours else None
    strategies.append(kind(state, contours))
    if contours is not None:
        strategies.append(contours)
    return strategies
