"""What happens to a fit besides the descent.

A strategy is a frozen dataclass whose fields are its thresholds. It holds no state: whatever it counts is a field of
:class:`~kcgs.fitting.state.FitState`, which a checkpoint keeps. Gaussians are added and removed by ``append`` and
``keep`` of the state's optimizer, or by :func:`~kcgs.fitting.removal.remove_gaussians`.
"""

from __future__ import annotations

from typing import Protocol

from kcgs.fitting.config import FitConfig
from kcgs.fitting.state import FitState

from .contours import AdaptContours, SettleContours
from .densify import Densify, DensifyAtLargestError
from .end_drafts import EndDrafts
from .warmup import Warmup

__all__ = [
    "Densify", "DensifyAtLargestError", "EndDrafts", "SettleContours", "Strategy", "Warmup",
    "make_densify", "make_strategies",
]  # fmt: skip


class Strategy(Protocol):
    """Something that happens to a fit from time to time."""

    def due(self, state: FitState) -> bool:
        """True when the strategy is to be applied before this iteration."""

    def apply(self, state: FitState) -> None:
        """Change the state."""


def make_strategies(config: FitConfig) -> list[Strategy]:
    """Return the strategies of a fit, in the order in which an iteration applies them."""
    densify = make_densify(config)
    strategies: list[Strategy] = [EndDrafts()]
    if config.warmup:
        strategies.append(Warmup())
    strategies.append(densify)
    if config.move_contours:
        strategies.append(SettleContours(densify.end))
    return strategies


def make_densify(config: FitConfig) -> Densify:
    """Return the strategy that adds Gaussians."""
    kind = Densify if config.densify == "matching-pursuit" else DensifyAtLargestError
    return kind(AdaptContours() if config.move_contours else None)
