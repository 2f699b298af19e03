"""Where label maps come from."""

from kcgs.segment.base import Segmenter, available_methods, register, segment
from kcgs.segment.classical import auto, felzenszwalb, slic
from kcgs.segment.cleanup import absorb_specks, connected_regions, merge_similar, order_by_area
from kcgs.segment.contours import snap_contours
from kcgs.segment.edges import watershed
from kcgs.segment.kmeans import kmeans
from kcgs.segment.mask_files import davis, file
from kcgs.segment.mask_models import sam
from kcgs.segment.onnx_model import lseg, onnx
from kcgs.segment.patch_features import dino
from kcgs.segment.sources import Cleanup, Segmentation, register_scored, segment_with_scores
from kcgs.segment.text_prompts import text

__all__ = [
    "Cleanup",
    "Segmentation",
    "Segmenter",
    "absorb_specks",
    "auto",
    "available_methods",
    "connected_regions",
    "davis",
    "dino",
    "felzenszwalb",
    "file",
    "kmeans",
    "lseg",
    "merge_similar",
    "onnx",
    "order_by_area",
    "register",
    "register_scored",
    "sam",
    "segment",
    "segment_with_scores",
    "slic",
    "snap_contours",
    "text",
    "watershed",
]
