"""Transitional: see kcgs.scene."""

from kcgs.scene import Scene, load, save, scene_bytes

__all__ = ["Scene", "load", "save", "scene_bytes"]
