"""The kernel `cpu`, in float32: numba loops over 8 pixels at a time; threads share the rows of tiles.

`kernel` plans with `lists` and `ellipse`, and runs the tasks of `schedule` in `loops`; these call the vector code of
`rows` and `spline`, which is written with `simd`. `gradients` is the last part of the backward. `layout` has the arrays
that all these modules read.
"""

from .kernel import kernel_for

__all__ = ["kernel_for"]
