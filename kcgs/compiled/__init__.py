"""Compiled loops: `program` compiles functions and keeps them, `tasks` runs them on threads; both load numba."""

from .threads import image_threads_for_kernels, num_threads, threads_for_kernels
from .workspace import Workspace, borrowed

__all__ = ["Workspace", "borrowed", "image_threads_for_kernels", "num_threads", "threads_for_kernels"]
