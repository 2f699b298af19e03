"""Label maps as kernels read them."""

from .coverage import TILE, Coverage, make_coverage
from .widths import RADIUS_SIGMAS, ContourWidths, find_widths

__all__ = ["RADIUS_SIGMAS", "TILE", "ContourWidths", "Coverage", "find_widths", "make_coverage"]
