"""Ways to evaluate the splat and its gradient; private: call `kcgs.functional.region_splat`."""

from .inputs import OutOfRangeError, SplatInputs, Steps, with_autograd
from .membership import Membership
from .registry import BACKENDS, check_backend, prepare, resolve
from .resampled import Crisp, Resampled
from .threads import image_threads_for_kernels, threads_for_kernels

__all__ = [
    "BACKENDS", "Crisp", "Membership", "OutOfRangeError", "Resampled", "SplatInputs", "Steps", "check_backend",
    "image_threads_for_kernels", "prepare", "resolve", "threads_for_kernels", "with_autograd",
]  # fmt: skip
