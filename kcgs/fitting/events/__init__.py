"""The events of a fit: they act between its steps.

An event that changes the scene is a frozen dataclass, and its fields are thresholds. What it counts is a field of
:class:`~kcgs.fitting.state.FitState`, which a checkpoint stores. It adds and removes Gaussians by ``append`` and
``keep`` of the state's optimizer. Other events only observe.
"""

from .contours import SettleContours
from .densify import Densify
from .observers import HandleDivergence, Log, OnStep, Report
from .warmup import Warmup

__all__ = ["Densify", "HandleDivergence", "Log", "OnStep", "Report", "SettleContours", "Warmup"]
