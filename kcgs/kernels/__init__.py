"""Ways to evaluate the splat and its gradient; private: call `kcgs.functional.region_splat`.

`registry` finds the kernel of a backend:

- `reference`: the formula, term by term.
- `tiled`: chunks of Gaussians and tiles in plain torch; autograd differentiates them.
- `cuda`: Triton programs, which plan, render and gather.
- `cpu`: numba loops over `lists` of Gaussians, with vector code.

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
