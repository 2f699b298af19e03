"""Where label maps come from."""

from kcgs.segment.base import Segmenter, available_methods, register, segment
from kcgs.segment.classical import auto, felzenszwalb, slic
from kcgs.segment.cleanup import absorb_specks, connected_regions, merge_similar, order_by_area
from kcgs.segment.contours import snap_contours

__all__ = [
    "Segmenter",
    "absorb_specks",
    "auto",
    "available_methods",
    "connected_regions",
    "felzenszwalb",
    "merge_similar",
    "order_by_area",
    "register",
    "segment",
    "slic",
    "snap_contours",
]
