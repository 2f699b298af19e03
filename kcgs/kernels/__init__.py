"""Ways to evaluate the splat and its gradient; private: call `kcgs.functional.region_splat`.

From the name of a backend to its innermost loop: `registry`, then one of four kernels.

- `reference`: the sum as it is written.
- `tiled`: `pairs` of Gaussians and tiles, matrix products.
- `cuda`: Triton's programs, which plan, render and gather.
- `cpu`: its own `lists`, numba's loops, vector code.

All take the inputs of `interface`, with a `membership`, perhaps `resampled`, and share `whitened` coordinates. All but
`reference` share `tiles` and `coarse_grids`; `splines` join these for tiled and cuda.
"""

from .cuda.capacity import settle, without_waiting
from .interface import SplatInputs, Steps, with_autograd
from .membership import Membership
from .registry import BACKENDS, check_backend, prepare, resolve, takes_triton
from .resampled import Resampled
from .threads import image_threads_for_kernels, threads_for_kernels, threads_for_torch

__all__ = [
    "BACKENDS", "Membership", "Resampled", "SplatInputs", "Steps", "check_backend",
    "image_threads_for_kernels", "prepare", "resolve", "settle", "takes_triton", "threads_for_kernels",
    "threads_for_torch", "with_autograd", "without_waiting",
]  # fmt: skip
