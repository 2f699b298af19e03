"""Segment images into label maps."""

from . import methods  # registers all methods
from .cleanup import Cleanup, Prediction, Segmentation
from .registry import available_methods, method_options, register, segment, segment_with_scores

__all__ = [
    "Cleanup", "Prediction", "Segmentation", "available_methods", "method_options", "register", "segment",
    "segment_with_scores",
]  # fmt: skip
