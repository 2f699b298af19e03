"""Ways to evaluate the splat and its gradient; private: call `kcgs.functional.region_splat`."""

from .autograd import SplatInputs
from .membership import Membership
from .registry import BACKENDS, compile_ahead, prepare, resolve
from .resampled import Resampled
from .threads import threads_for_kernels

__all__ = [
    "BACKENDS", "Membership", "Resampled", "SplatInputs", "compile_ahead", "prepare", "resolve", "threads_for_kernels",
]  # fmt: skip
