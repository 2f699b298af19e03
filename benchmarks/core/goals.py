"""Goals beside what was measured."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from .tables import format_value, markdown, title


class Goal(NamedTuple):
    """The most that a quantity of a case may be, or the least where more is better."""

    case: str
    quantity: str
    limit: float
    measured: float
    more_is_better: bool = False

    @property
    def missed(self) -> bool:
        """True where the measured value is beyond the limit."""
        return self.measured < self.limit if self.more_is_better else self.measured > self.limit


def goals_table(goals: Sequence[Goal]) -> str:
    """Lay out goals and what was measured, under a heading; "" where there are no goals."""
    lines = []
    for goal in goals:
        limit, measured = (format_value(goal.quantity, value) for value in (goal.limit, goal.measured))
        if goal.missed and measured == limit:
            measured = f"{goal.measured:.5g}"
        verb = "missed" if goal.missed else "reached"
        lines.append(
            [goal.case, title(goal.quantity), f"{'>=' if goal.more_is_better else '<='} {limit}", measured, verb]
        )
    return f"Goals:\n\n{markdown(['case', 'quantity', 'goal', 'measured', ''], lines)}" if lines else ""


def missed_goals(goals: Sequence[Goal]) -> str:
    """Say which goals were missed; "" where none was."""
    missed = [f"{goal.case}, {title(goal.quantity)}" for goal in goals if goal.missed]
    return f"{len(missed)} of {len(goals)} goals are missed: {'; '.join(missed)}." if missed else ""
