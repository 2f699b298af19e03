"""How well and how fast each recipe fits, on one kernel: `kcgs bench fit`."""

from .experiment import run

__all__ = ["run"]
