"""Ways to evaluate the splat and its gradient; private: call `kcgs.functional.region_splat`.

From the name of a backend to its innermost loop: `registry`, then one of four kernels.

- `reference`: the sum as it is written.
- `tiled`: chunks of Gaussians and tiles, plain torch, the gradient by autograd.
- `cuda`: Triton's programs, which plan, render and gather.
- `cpu`: its own `lists`, numba's loops, vector code.

All take the inputs of `interface`, and share `whitened` coordinates.
`tiled` and `cuda` share `tiles`; `cpu` evaluates wide Gaussians on `coarse_grids`.
"""

from .coarse_grids import Blocks, Coarsened, choose_levels, coarsen, make_blocks, max_spacing
from .cuda.capacity import settle, without_waiting
from .interface import Kernel, SplatInputs
from .registry import BACKENDS, check_backend, resolve, takes_triton, warm_up
from .tiles import bounding_tiles, find_keys
from .whitened import (
    MEAN_LIMIT,
    SCALE_LIMITS,
    SCALE_TOLERANCE,
    Z_LIMIT,
    affine_coefficients,
    least_exponent,
    least_whitened,
    support_radius,
    whiten,
)

__all__ = [
    "BACKENDS", "MEAN_LIMIT", "SCALE_LIMITS", "SCALE_TOLERANCE", "Z_LIMIT", "Blocks", "Coarsened", "Kernel",
    "SplatInputs", "affine_coefficients", "bounding_tiles", "check_backend", "choose_levels", "coarsen", "find_keys",
    "least_exponent", "least_whitened", "make_blocks", "max_spacing", "resolve", "settle", "support_radius",
    "takes_triton", "warm_up", "whiten", "without_waiting",
]  # fmt: skip
