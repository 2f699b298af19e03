"""All quality figures of a picture at once."""

from __future__ import annotations

import math
import warnings

from torch import Tensor

from kcgs.functional import ef_psnr, ef_ssim, ms_ssim, psnr, ssim


def measure(picture: Tensor, image: Tensor, labels: Tensor | None) -> dict[str, float]:
    """Compare `picture` with `image`, (C, H, W); a figure that is not defined here is NaN.

    Args:
        picture: what was drawn.
        image: what should have been.
        labels: label map whose contours the edge-focused figures look at; None: there are none.
    """
    with warnings.catch_warnings():
        # a missing figure is shown as missing
        warnings.simplefilter("ignore", RuntimeWarning)
        figures = {
            "psnr": float(psnr(picture, image)),
            "ssim": float(ssim(picture, image)),
            "ms_ssim": float(ms_ssim(picture, image)),
            "ef_psnr": math.nan,
            "ef_ssim": math.nan,
        }
        if labels is not None:
            figures["ef_psnr"] = float(ef_psnr(picture, image, labels))
            figures["ef_ssim"] = float(ef_ssim(picture, image, labels))
    return figures
