"""Stateless public operations: splatting, covariances, label maps, metrics."""

from .boundaries import BoundaryScore, boundary_f_score, coverage, edge_alignment, edge_alignment_map, smooth_contours
from .covariance import (
    cholesky_to_conic,
    cholesky_to_covariance,
    cholesky_to_scale_rotation,
    covariance_to_cholesky,
    scale_rotation_to_cholesky,
    support_extent,
)
from .labels import contour_edges, edge_band, lookup_regions, touching_pairs
from .merging import merge_regions
from .metrics import ef_psnr, ef_ssim, ms_ssim, psnr, ssim
from .polygons import polygon_coverage, polygon_labels
from .regions import RegionMap
from .softness import MAX_SOFTNESS, PairWidths
from .splat import region_splat
from .widths import BandGain, band_gain, choose_widths

__all__ = [
    "MAX_SOFTNESS", "BandGain", "BoundaryScore", "PairWidths", "RegionMap", "band_gain", "boundary_f_score",
    "cholesky_to_conic", "cholesky_to_covariance", "cholesky_to_scale_rotation", "choose_widths", "contour_edges",
    "covariance_to_cholesky", "coverage", "edge_alignment", "edge_alignment_map", "edge_band", "ef_psnr", "ef_ssim",
    "lookup_regions", "merge_regions", "ms_ssim", "polygon_coverage", "polygon_labels", "psnr", "region_splat",
    "scale_rotation_to_cholesky", "smooth_contours", "ssim", "support_extent", "touching_pairs",
]  # fmt: skip
