"""A video in, a clip out: each frame starts from the one before, moved region by region."""

from .fitting import fit_video

__all__ = ["fit_video"]
