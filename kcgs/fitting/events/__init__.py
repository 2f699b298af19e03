"""The events of a fit: they act between its steps.

An event that changes the scene is a frozen dataclass, and its fields are thresholds. What it counts is a field of
:class:`~kcgs.fitting.state.FitState`, which a checkpoint stores. It adds and removes Gaussians by ``append`` and
``keep`` of the state's optimizer. Other events only observe.
"""

from .contours import SettleContours
from .densify import Densify
from .divergence import HandleDivergence
from .drafts import EndDrafts
from .log import Log
from .report import OnStep, Report

__all__ = ["Densify", "EndDrafts", "HandleDivergence", "Log", "OnStep", "Report", "SettleContours"]
