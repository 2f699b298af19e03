"""The splat on the CPU, in float32: numba, 16 pixels at a time, rows of tiles shared among threads."""

from .kernel import steps

__all__ = ["steps"]
