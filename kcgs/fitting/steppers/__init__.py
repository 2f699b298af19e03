"""Steps and measurements of a fit, on a CPU and on a GPU."""

from __future__ import annotations

from kcgs.fitting.state import FitState
from kcgs.optim import GaussianAdam

from .cuda import CudaStepper
from .eager import EagerStepper, Stepper

__all__ = ["CudaStepper", "EagerStepper", "Stepper", "make_stepper"]


def make_stepper(state: FitState) -> Stepper:
    """Return the stepper of a fit's device and optimizer.

    On a GPU steps of GaussianAdam are not waited for: it leaves out gradients of NaN, those of a step that the device
    had no room for. Other optimizers do not.
    """
    runs_ahead = state.problem.device.type == "cuda" and isinstance(state.optimizer, GaussianAdam)
    return CudaStepper(state) if runs_ahead else EagerStepper(state)
