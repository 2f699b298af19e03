"""The events that change the scene of a fit, as its settings ask for."""

from __future__ import annotations

from kcgs.optim import Event

from .events import Densify, EndDrafts, SettleContours
from .problem import Problem
from .published.warmup import Warmup


def make_schedule(problem: Problem) -> list[Event]:
    """Return the events, in the order in which they act."""
    config, densify = problem.config, problem.objects.densify or Densify()
    events: list[Event] = [EndDrafts()]
    if config.warmup:
        events.append(Warmup())
    events.append(densify)
    if config.move_contours:
        events.append(SettleContours(densify.end))
    return events
