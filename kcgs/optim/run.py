"""The loop of every descent: steps, and events between them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Protocol, runtime_checkable

# the rate at the end of a descent by Adam, in units of the rate at its start
_FINAL_DECAY = 0.1


class Descent(Protocol):
    """Gaussians that `run` moves to less error."""

    iteration: int
    progress: float  # share of the descent that is over


@runtime_checkable
class Event(Protocol):
    """An action between the steps of a descent, which `run` offers before every step."""

    def act(self, descent: Any) -> str | None:
        """Change or observe the descent, if it is time to; return why the descent ends here, or None.

        `run` calls it before every step; the event itself decides when to act.
        """


def run(
    descent: Descent,
    step: Callable[[float], None],
    progress: Callable[[], float],
    events: Sequence[Event],
    rate: Callable[[float], float],
) -> str:
    """Let events act, then step, until an event gives a reason to end; return the reason.

    Args:
        descent: the state that moves.
        step: moves the descent once, by a share of the largest step, and counts the iteration.
        progress: share of the descent that is over, from 0 to 1.
        events: act before a step, in this order.
        rate: share of the largest step, by progress.
    """
    while True:
        descent.progress = progress()
        for event in events:
            if reason := event.act(descent):
                return reason
        step(rate(descent.progress))


def count_iterations(descent: Descent, iterations: float) -> Callable[[], float]:
    """Return a function that gives the share of `iterations` that a descent has done."""
    return lambda: descent.iteration / iterations if iterations else 1.0


class End:
    """Ends a descent when a share `until` of it is over."""

    def __init__(self, until: float = 1.0, reason: Callable[[], str] = lambda: "iterations") -> None:
        self.until, self.reason = until, reason

    def act(self, descent: Descent) -> str | None:
        """See :class:`Event`."""
        return self.reason() if descent.progress >= self.until else None


class TimedAction:
    """Acts once at each of several ascending shares of a descent."""

    def __init__(self, times: Iterable[float], action: Callable[[], None]) -> None:
        self._times, self._action = iter([*times, math.inf]), action
        self._next = next(self._times)

    def act(self, descent: Descent) -> None:
        """See :class:`Event`."""
        if descent.progress >= self._next:
            self._action()
            self._next = next(self._times)


def cosine_decay(progress: float) -> float:
    """Return a factor that falls along a cosine from 1 to a tenth."""
    cosine = 0.5 * (1 + math.cos(math.pi * min(max(progress, 0.0), 1.0)))
    return _FINAL_DECAY + (1 - _FINAL_DECAY) * cosine
