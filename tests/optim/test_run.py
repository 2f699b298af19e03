"""The loop of every descent: the order of steps and events, and the events that all descents have."""

from __future__ import annotations

from typing import Any

import pytest

from kcgs.optim import End, TimedAction, cosine_decay, count_iterations, run


class Counter:
    """A descent that counts its steps, and writes down what happens."""

    def __init__(self) -> None:
        self.iteration, self.progress = 0, 0.0
        self.news: list[Any] = []

    def step(self, rate: float) -> None:
        self.iteration += 1
        self.news.append(rate)

    def write(self, text: str) -> None:
        self.news.append((text, self.iteration))


class Writer:
    def __init__(self, text: str, reason: str | None = None) -> None:
        self.text, self.reason = text, reason

    def act(self, descent: Counter) -> str | None:
        descent.write(self.text)
        return self.reason if descent.iteration == 2 else None


def test_events_act_in_their_order_before_each_step() -> None:
    descent = Counter()
    reason = run(
        descent, descent.step, count_iterations(descent, 4), [Writer("a"), Writer("b", "enough"), Writer("c")],
        lambda progress: 1 - progress,
    )  # fmt: skip
    assert reason == "enough"
    assert descent.news == [
        ("a", 0), ("b", 0), ("c", 0), 1.0, ("a", 1), ("b", 1), ("c", 1), 0.75, ("a", 2), ("b", 2),
    ]  # fmt: skip


def test_timed_actions_act_once_at_each_time() -> None:
    descent, times = Counter(), []
    action = TimedAction([0.0, 0.34, 0.35, 0.9], lambda: times.append(descent.iteration))
    assert run(descent, descent.step, count_iterations(descent, 10), [End(), action], lambda _: 1.0) == "iterations"
    assert times == [0, 4, 5, 9] and descent.iteration == 10


@pytest.mark.parametrize(("until", "iterations"), [(1.0, 8), (0.5, 4), (0.0, 0)])
def test_a_descent_ends_at_a_share(until: float, iterations: int) -> None:
    descent = Counter()
    end = End(until, lambda: f"at {descent.iteration}")
    assert run(descent, descent.step, count_iterations(descent, 8), [end], lambda _: 1.0) == f"at {iterations}"


def test_no_iterations_are_over_at_once() -> None:
    descent = Counter()
    assert run(descent, descent.step, count_iterations(descent, 0), [End()], lambda _: 1.0) == "iterations"
    assert descent.iteration == 0


def test_the_rate_falls_to_a_tenth() -> None:
    assert [cosine_decay(p) for p in (-1.0, 0.0, 0.5, 1.0, 2.0)] == pytest.approx([1.0, 1.0, 0.55, 0.1, 0.1])
