"""What happens to a fit besides its steps.

An event that changes the scene is a frozen dataclass whose fields are its thresholds; whatever it counts is a field of
:class:`~kcgs.fitting.state.FitState`, which a checkpoint keeps. Gaussians are added and removed
by ``append`` and ``keep`` of the state's optimizer. Others observe.
"""

from .contours import AdaptContours, SettleContours
from .densify import Densify
from .divergence import HandleDivergence
from .drafts import EndDrafts
from .log import Log
from .report import OnStep, Report

__all__ = [
    "AdaptContours", "Densify", "EndDrafts", "HandleDivergence", "Log", "OnStep", "Report", "SettleContours",
]  # fmt: skip
