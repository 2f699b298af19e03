"""Where label maps come from."""

from kcgs.segment.cleanup import connected_regions, merge_similar, merge_small, order_by_area
from kcgs.segment.methods.classical import auto, felzenszwalb, slic
from kcgs.segment.methods.edges import watershed
from kcgs.segment.methods.kmeans import kmeans
from kcgs.segment.methods.mask_files import davis, file
from kcgs.segment.methods.onnx_networks import lseg, onnx
from kcgs.segment.methods.patch_features import dino
from kcgs.segment.methods.segment_anything import sam
from kcgs.segment.methods.text_prompts import text
from kcgs.segment.registry import (
    Cleanup,
    Prediction,
    Segmentation,
    Segmenter,
    available_methods,
    register,
    segment,
    segment_with_scores,
)
from kcgs.segment.snapping import snap_contours

__all__ = [
    "Cleanup", "Prediction", "Segmentation", "Segmenter", "auto", "available_methods", "connected_regions", "davis",
    "dino", "felzenszwalb", "file", "kmeans", "lseg", "merge_similar", "merge_small", "onnx", "order_by_area",
    "register", "sam", "segment", "segment_with_scores", "slic", "snap_contours", "text", "watershed",
]  # fmt: skip
