"""The splat on the CPU, in float32: numba, 16 pixels at a time, rows of tiles shared among threads."""

from .kernel import splat

__all__ = ["splat"]
