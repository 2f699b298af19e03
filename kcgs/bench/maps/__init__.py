"""What label maps that nobody drew are worth: `kcgs bench maps`."""

from .experiment import run

__all__ = ["run"]
