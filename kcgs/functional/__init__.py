"""Stateless public operations: splatting, covariances, label maps, metrics."""

from kcgs.maps import PairSoftness, RegionMap, edge_band, lookup_regions

from .activation import activate_gaussians
from .blur import blur, gaussian_taps, halve
from .contour_fit import choose_softness
from .covariance import (
    check_cholesky,
    cholesky_to_covariance,
    cholesky_to_scale_rotation,
    covariance_to_cholesky,
    scale_rotation_to_cholesky,
)
from .execution import squared_error_gradients
from .merging import merge_regions
from .metrics import METRICS, ef_psnr, ef_ssim, ms_ssim, psnr, ssim, ssimulacra2
from .similarity import K1, K2, SCALE_WEIGHTS, SSIM_SIGMA, SSIM_WINDOW, window_mean, window_taps
from .splat import region_splat, splat_at
from .tokens import from_tokens, to_tokens
from .values import check_values

# public; other packages of kcgs use the other imports
__all__ = [
    "PairSoftness", "RegionMap", "activate_gaussians", "cholesky_to_covariance", "cholesky_to_scale_rotation",
    "choose_softness", "covariance_to_cholesky", "edge_band", "ef_psnr", "ef_ssim", "from_tokens", "lookup_regions",
    "merge_regions", "ms_ssim", "psnr", "region_splat", "scale_rotation_to_cholesky", "ssim", "ssimulacra2",
    "to_tokens",
]  # fmt: skip
