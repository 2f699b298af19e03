"""Segment images into label maps."""

from kcgs.segment import methods  # registers all methods
from kcgs.segment.cleanup import Cleanup, Prediction, Segmentation
from kcgs.segment.registry import available_methods, method_options, register, segment, segment_with_scores

__all__ = [
    "Cleanup", "Prediction", "Segmentation", "available_methods", "method_options", "register", "segment",
    "segment_with_scores",
]  # fmt: skip
