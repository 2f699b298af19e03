"""The kernel `cpu`, in float32: numba, 8 pixels at a time, rows of tiles shared among threads.

`kernel` plans with `lists` and `ellipse`, and runs the tasks of `schedule` in `loops`; these call the vector code of
`rows` and `spline`, which is written with `simd`. `gradients` ends the backward. `layout` has the arrays that all of
them read.
"""

from .kernel import kernel_for

__all__ = ["kernel_for"]
