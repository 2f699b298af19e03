"""Ways to evaluate the splat and its gradient; private: call `kcgs.functional.region_splat`."""

from .autograd import SplatInputs
from .membership import Membership
from .registry import BACKENDS, resolve
from .resampled import Resampled

__all__ = ["BACKENDS", "Membership", "Resampled", "SplatInputs", "resolve"]
