"""Compiled loops: `program` compiles functions and keeps them, `tasks` runs them on threads; both load numba."""

from .threads import image_threads_for_kernels, num_threads, threads_for_kernels

__all__ = ["image_threads_for_kernels", "num_threads", "threads_for_kernels"]
