"""The events of a fit, by its settings."""

from __future__ import annotations

from kcgs.optim import Event

from .config import FitConfig
from .events import AdaptContours, Densify, EndDrafts, SettleContours
from .published.largest_error import DensifyAtLargestError
from .published.warmup import Warmup

_DENSIFIERS = {"matching-pursuit": Densify, "largest-error": DensifyAtLargestError}


def make_schedule(config: FitConfig) -> list[Event]:
    """Return the events that change the scene, in the order in which they act."""
    densify = make_densify(config)
    events: list[Event] = [EndDrafts()]
    if config.warmup:
        events.append(Warmup())
    events.append(densify)
    if config.move_contours:
        events.append(SettleContours(getattr(densify, "end", Densify.end)))
    return events


def make_densify(config: FitConfig) -> Event:
    """Return the event that adds Gaussians: by name, or the user's own."""
    if not isinstance(config.densify, str):
        return config.densify
    return _DENSIFIERS[config.densify](AdaptContours() if config.move_contours else None)
