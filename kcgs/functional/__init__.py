"""Stateless public operations: splatting, covariances, label maps, metrics."""

from kcgs.maps import PairSoftness, RegionMap, edge_band, lookup_regions

from .activation import activate_gaussians
from .contour_fit import choose_softness
from .covariance import (
    cholesky_to_covariance,
    cholesky_to_scale_rotation,
    covariance_to_cholesky,
    scale_rotation_to_cholesky,
)
from .merging import merge_regions
from .metrics import ef_psnr, ef_ssim, ms_ssim, psnr, ssim
from .splat import region_splat

__all__ = [
    "PairSoftness", "RegionMap", "activate_gaussians", "cholesky_to_covariance", "cholesky_to_scale_rotation",
    "choose_softness", "covariance_to_cholesky", "edge_band", "ef_psnr", "ef_ssim", "lookup_regions", "merge_regions",
    "ms_ssim", "psnr", "region_splat", "scale_rotation_to_cholesky", "ssim",
]  # fmt: skip
