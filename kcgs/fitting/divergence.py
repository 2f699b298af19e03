"""The end of a fit whose numbers are not finite."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kcgs._warn import warn_user
from kcgs.nn import GaussianField
from kcgs.optim import is_within

from .readback import Readback
from .state import FitState

# numbers beyond it are near overflow
_LARGEST = 1e15
# where the host runs ahead of a device; more of them let it run farther
_ITERATIONS_PER_CHECK = 10


class StopAtDivergence:
    """Ends a fit with a number that is not finite, or near overflow; where the host runs ahead, some iterations late.

    There it waits, every ten iterations, for what the device did ten iterations before: so it is never twenty ahead.
    Where a step had gradients of NaN, since its lists did not fit, the next one waits, to learn how much they take.
    """

    def due(self, state: FitState) -> float:
        """Return the progress at the next check, or less."""
        return state.next_multiple(_ITERATIONS_PER_CHECK) if state.runs_ahead else state.progress

    def act(self, state: FitState) -> str | None:
        """Check, warn, and return why the fit ends."""
        if not _has_diverged(state):
            return None
        warn_user(f"the fit diverged at iteration {state.iteration}: the best so far is kept")
        return "diverged"


def _has_diverged(state: FitState) -> bool:
    field = state.field
    if not state.runs_ahead:
        return not is_finite(field)
    if state.iteration % _ITERATIONS_PER_CHECK:
        return False
    tables = field.means, field.cholesky, field.colors
    gradients = [table.grad for table in tables if table.grad is not None]
    previous, state.magnitudes = state.magnitudes, Readback(_magnitudes([*tables, *gradients]))
    if previous is None:
        return False
    numbers, columns = previous.numbers(), sum(table.shape[1] for table in tables)
    if any(map(math.isnan, numbers[columns:])):
        state.lacks_room = True
    return not all(number < _LARGEST for number in numbers[:columns])


def is_finite(field: GaussianField) -> bool:
    """True where every number is finite, and far from overflow."""
    tables = field.means, field.cholesky, field.colors
    if not field.means.is_cpu:
        return bool((_magnitudes(tables) < _LARGEST).all())
    return is_within(tables, _LARGEST)


@torch.no_grad()
def _magnitudes(tables: Sequence[Tensor]) -> Tensor:
    """Return the largest absolute number of each column of tables, (N, K) each; a NaN is the largest."""
    return torch.cat([*tables], -1).abs().amax(0)
