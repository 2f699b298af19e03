"""Label maps: `RegionMap`, labels and softness, and the table of a map that kernels and decoders read."""

from .antialiasing import antialias, shifted
from .coverage import TILE, Coverage, make_coverage
from .labels import (
    compact,
    contour_edges,
    edge_band,
    lookup_regions,
    pixels_under,
    touching_pairs,
    unique_pairs,
)
from .map_tables import MapOperands, tables_at
from .membership import Membership, TileMembership
from .regions import RegionMap, as_region_map, map_operands, wrap_labels
from .resampled import LEAST_BLUR, PIXEL, Resampled, SmoothMembership, sharpness
from .softness import MAX_SOFTNESS, PairSoftness
from .widths import RADIUS_SIGMAS, ContourWidths, find_widths

__all__ = [
    "LEAST_BLUR",
    "MAX_SOFTNESS",
    "PIXEL",
    "RADIUS_SIGMAS",
    "TILE",
    "ContourWidths",
    "Coverage",
    "MapOperands",
    "Membership",
    "PairSoftness",
    "RegionMap",
    "Resampled",
    "SmoothMembership",
    "TileMembership",
    "antialias",
    "as_region_map",
    "compact",
    "contour_edges",
    "edge_band",
    "find_widths",
    "lookup_regions",
    "make_coverage",
    "map_operands",
    "pixels_under",
    "sharpness",
    "shifted",
    "tables_at",
    "touching_pairs",
    "unique_pairs",
    "wrap_labels",
]  # fmt: skip
