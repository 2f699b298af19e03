"""Stateless public operations: splatting, covariances, label maps, metrics."""

from .contours import smooth_contours
from .covariance import (
    cholesky_to_conic,
    cholesky_to_covariance,
    cholesky_to_scale_rotation,
    covariance_to_cholesky,
    scale_rotation_to_cholesky,
    support_extent,
)
from .metrics import ef_psnr, ef_ssim, ms_ssim, psnr, ssim
from .regions import RegionMap, edge_band, lookup_regions
from .splat import region_splat

__all__ = [
    "RegionMap",
    "cholesky_to_conic",
    "cholesky_to_covariance",
    "cholesky_to_scale_rotation",
    "covariance_to_cholesky",
    "edge_band",
    "ef_psnr",
    "ef_ssim",
    "lookup_regions",
    "ms_ssim",
    "psnr",
    "region_splat",
    "scale_rotation_to_cholesky",
    "smooth_contours",
    "ssim",
    "support_extent",
]
