"""Stateless public operations: splatting, covariances, label maps, metrics."""

from .covariance import (
    cholesky_to_covariance,
    cholesky_to_scale_rotation,
    covariance_to_cholesky,
    scale_rotation_to_cholesky,
)
from .labels import contour_edges, edge_band, lookup_regions, touching_pairs
from .merging import merge_regions
from .metrics import ef_psnr, ef_ssim, ms_ssim, psnr, ssim
from .regions import RegionMap
from .softness import MAX_SOFTNESS, PairWidths
from .splat import region_splat
from .widths import BandGain, band_gain, choose_widths

__all__ = [
    "MAX_SOFTNESS", "BandGain", "PairWidths", "RegionMap", "band_gain", "cholesky_to_covariance",
    "cholesky_to_scale_rotation", "choose_widths", "contour_edges", "covariance_to_cholesky",
    "edge_band", "ef_psnr", "ef_ssim", "lookup_regions", "merge_regions", "ms_ssim", "psnr",
    "region_splat", "scale_rotation_to_cholesky", "ssim", "touching_pairs",
]  # fmt: skip
