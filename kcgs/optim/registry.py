"""Objectives by the names that settings have."""

from .ms_ssim import MsSsim
from .objectives import AbsoluteError, ImageObjective, SquaredError

OBJECTIVES: dict[str, type[ImageObjective]] = {"l2": SquaredError, "l1": AbsoluteError, "ms-ssim": MsSsim}
