"""Label maps: `RegionMap`, labels and softness, and the table of a map that kernels and decoders read."""

from .antialiasing import antialias, shifted
from .arguments import as_region_map, table_and_size
from .derived import derive, membership_at, table_at
from .interior import interior_points
from .labels import (
    compact,
    contour_edges,
    edge_band,
    lookup_regions,
    nearest_labels,
    pixels_under,
    positions_of,
    touching_pairs,
    unique_pairs,
)
from .membership import Membership
from .region_graph import Labels, RegionGraph, merge_nearest, pairs_to_merge
from .regions import RegionMap, wrap_labels
from .resampled import LEAST_BLUR, Resampled, SmoothMembership, cut_windows, find_windows, sharpness
from .softness import MAX_SOFTNESS, PairSoftness, softness_from_plain, softness_to_plain
from .table import PER_MAP, SHARED, MapTable, with_positions
from .tile import TILE
from .widths import RADIUS_SIGMAS, truncated_gaussian

__all__ = [
    "LEAST_BLUR", "MAX_SOFTNESS", "PER_MAP", "RADIUS_SIGMAS", "SHARED", "TILE", "Labels", "MapTable",
    "Membership", "PairSoftness", "RegionGraph", "RegionMap", "Resampled", "SmoothMembership", "antialias",
    "as_region_map", "compact", "contour_edges", "cut_windows", "derive", "edge_band", "find_windows",
    "interior_points", "lookup_regions", "membership_at", "merge_nearest", "nearest_labels", "pairs_to_merge",
    "pixels_under", "positions_of", "sharpness", "shifted", "softness_from_plain", "softness_to_plain",
    "table_and_size", "table_at", "touching_pairs", "truncated_gaussian",
    "unique_pairs", "with_positions", "wrap_labels",
]  # fmt: skip
