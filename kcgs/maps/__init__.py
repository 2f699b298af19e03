"""Label maps: `RegionMap`, labels and softness, and the table of a map that kernels and decoders read.

Users have the public names from `kcgs.functional`.
"""

from .antialiasing import antialias
from .arguments import as_region_map, table_and_size
from .derived import cached_for, membership_at, table_at
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
from .resampled import LEAST_BLUR, SmoothMembership, cut_windows, find_windows, sharpness
from .softness import (
    MAX_SOFTNESS,
    GivenSoftness,
    PairSoftness,
    largest_softness,
    mean_softness,
    softness_between,
    softness_from_plain,
    softness_of_map,
    softness_to_plain,
)
from .table import PER_MAP, SHARED, MapTable, with_positions
from .tile import TILE
from .widths import RADIUS_SIGMAS, truncated_gaussian
