"""The experiments and their reports."""

from .core.registry import available_experiments, run

__all__ = ["available_experiments", "run"]
