"""Label maps as kernels read them."""

from .coverage import RADIUS_SIGMAS, Coverage, make_coverage

__all__ = ["RADIUS_SIGMAS", "Coverage", "make_coverage"]
