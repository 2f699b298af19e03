"""Steps and measurements of a fit: their protocol, and the stepper that waits for each step."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor

from kcgs.optim import GaussianAdam, step_field

from .measurement import measure_errors, record, snapshot
from .state import FitState
from .stepper_cuda import CudaStepper


class Stepper(Protocol):
    """Moves and measures the Gaussians of one fit on its device."""

    def step(self, rate: float) -> None:
        """Move the Gaussians once, with `rate` as factor on the learning rates, and count the iteration."""

    def measure(self, seconds: float) -> None:
        """Render and measure the scene, `seconds` after the start; the next step differentiates this render."""

    def poll(self, *, wait: bool = False) -> None:
        """Record the measurements that the device has finished; with `wait`, all measurements."""

    def overflowing_images(self) -> list[int]:
        """Return the images that overflow: see :meth:`FitState.overflowing_images`."""


class EagerStepper:
    """Steps that are complete when they return, on any device."""

    def __init__(self, state: FitState) -> None:
        self._state = state
        self._rendered: Tensor | None = None

    def step(self, rate: float) -> None:
        """See :class:`Stepper`."""
        rendered, self._rendered = self._rendered, None
        step_field(self._state, rate, rendered)

    def measure(self, seconds: float) -> None:
        """See :class:`Stepper`."""
        state = self._state
        self._rendered = state.render()
        record(state, snapshot(state, seconds), measure_errors(state.problem, self._rendered))

    def poll(self, *, wait: bool = False) -> None:
        """See :class:`Stepper`: `measure` has recorded all measurements."""

    def overflowing_images(self) -> list[int]:
        """See :class:`Stepper`."""
        return self._state.overflowing_images()


def make_stepper(state: FitState) -> Stepper:
    """Return the stepper of a fit's device and optimizer.

    On a GPU the host does not wait for steps of GaussianAdam. A step that finds no room on the device has gradients of
    NaN: GaussianAdam skips them, other optimizers do not.
    """
    runs_ahead = state.problem.device.type == "cuda" and isinstance(state.optimizer, GaussianAdam)
    return CudaStepper(state) if runs_ahead else EagerStepper(state)
