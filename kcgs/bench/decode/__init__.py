"""How fast and how exactly a scene is drawn by each of its decoders: `kcgs bench decode`."""

from .experiment import run

__all__ = ["run"]
