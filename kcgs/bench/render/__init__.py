"""How fast and how exactly each backend draws: `kcgs bench render`."""

from .experiment import run

__all__ = ["run"]
