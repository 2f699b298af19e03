"""Label maps: `RegionMap`, labels and softness, and the table of a map that kernels and decoders read."""

from .antialiasing import antialias, shifted
from .arguments import as_region_map, map_operands
from .coverage import TILE, Coverage, make_coverage
from .interior import interior_points
from .labels import (
    compact,
    contour_edges,
    edge_band,
    lookup_regions,
    pixels_under,
    positions_of,
    touching_pairs,
    unique_pairs,
)
from .membership import Membership
from .operands import MapOperands, membership_at
from .region_graph import Labels, RegionGraph, merge_nearest, pairs_to_merge
from .regions import RegionMap, wrap_labels
from .resampled import LEAST_BLUR, PIXEL, Resampled, SmoothMembership, cut_windows, find_windows, sharpness
from .softness import MAX_SOFTNESS, PairSoftness
from .widths import RADIUS_SIGMAS, ContourWidths, find_widths

__all__ = [
    "LEAST_BLUR", "MAX_SOFTNESS", "PIXEL", "RADIUS_SIGMAS", "TILE", "ContourWidths", "Coverage", "Labels",
    "MapOperands", "Membership", "PairSoftness", "RegionGraph", "RegionMap", "Resampled", "SmoothMembership",
    "antialias", "as_region_map", "compact", "contour_edges", "cut_windows", "edge_band", "find_widths", "find_windows",
    "interior_points", "lookup_regions", "make_coverage", "map_operands", "membership_at", "merge_nearest",
    "pairs_to_merge", "pixels_under", "positions_of", "sharpness", "shifted",
    "touching_pairs", "unique_pairs", "wrap_labels",
]  # fmt: skip
