"""Steps and measurements of a fit, on a CPU and on a GPU."""

from __future__ import annotations

from kcgs.fitting.state import FitState
from kcgs.optim import GaussianAdam

from .cuda import CudaStepper
from .eager import EagerStepper, Stepper

__all__ = ["CudaStepper", "EagerStepper", "Stepper", "make_stepper"]


def make_stepper(state: FitState) -> Stepper:
    """Return the stepper of a fit's device and optimizer.

    On a GPU the host does not wait for steps of GaussianAdam. A step that finds no room on the device has gradients of
    NaN: GaussianAdam skips them, other optimizers do not.
    """
    runs_ahead = state.problem.device.type == "cuda" and isinstance(state.optimizer, GaussianAdam)
    return CudaStepper(state) if runs_ahead else EagerStepper(state)
