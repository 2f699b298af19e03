"""Tuned numbers of a file of a size: its Gaussians, their least width, and the iterations."""

from __future__ import annotations

import math
from dataclasses import dataclass

from kcgs._objectives import ObjectiveName
from kcgs.fitting import FitConfig, Problem

# fixed-point iterations for the number of Gaussians, since the bits per Gaussian depend on it
_COUNT_ITERATIONS = 4

# These numbers are tuned: change one and compare the files of `python -m benchmarks rate`, which have the same size.

# share of a fit's schedule that is run; the descent of `compress` replaces the rest. More: slower
FIT_SHARE = 0.845
# the same share with a label map; at least 0.88, where contours move for the last time
FIT_SHARE_WITH_REGIONS = 0.89
# least standard deviation of the Gaussians on a reduced photo, in its pixels. More: slower, and finer details
_PIXELS_PER_SIGMA = 1.5


@dataclass(frozen=True)
class GaussianBudget:
    """The number of Gaussians for a size of a file, their least width, and the iterations of fit and rounding.

    With more Gaussians there are fewer bits for each: the fit has less error, and rounding adds more. All fields are
    tuned. To tune one again, change it and compare the files of ``python -m benchmarks rate``: all have the same size.
    """

    bits_per_gaussian: float = 25.2
    """Bits of the file per Gaussian of the fit, at `reference_count` Gaussians and without the least number of bits.
    More: fewer Gaussians, each rounded less."""
    reference_count: int = 2100
    """Number of Gaussians for which `bits_per_gaussian` holds."""
    bits_per_doubling: float = 1.9
    """Increase of the bits per Gaussian for each doubling of the number of Gaussians. More: large files get fewer
    Gaussians."""
    min_bits_per_gaussian: float = 26.0
    """Least bits per Gaussian. With the other defaults they hold for up to 2,800 Gaussians."""
    header_bytes: int = 30
    """Bytes of a file besides Gaussians and map."""
    least_spacing: float = math.inf
    """Spacing of Gaussians, sqrt(pixels / N), in pixels, above which they have a least width. More: sharper edges, and
    more stray strokes."""
    width_per_spacing: float = 0.12
    """Least standard deviation, in pixels, per pixel of spacing above `least_spacing`. More: softer images, and fewer
    stray strokes."""

    fit_iterations: int = 700
    """Iterations of the schedule of a fit. More: slower, and less error."""
    compress_iterations: int = 600
    """Renders that descent and rounding together take. More: slower, and less error."""

    def num_gaussians(self, target_bytes: float, pixels: int) -> int:
        """Return the number of Gaussians, from 1 to `pixels`, of a file of at most `target_bytes` without a map."""
        bits = 8 * max(target_bytes - self.header_bytes, 1)
        count = bits / self.bits_per_gaussian
        for _ in range(_COUNT_ITERATIONS):
            doublings = math.log2(max(count, 1.0) / self.reference_count)
            bits_per_gaussian = self.bits_per_gaussian + self.bits_per_doubling * doublings
            count = bits / max(bits_per_gaussian, self.min_bits_per_gaussian)
        return min(max(1, round(count)), pixels)

    def min_sigma(self, num_gaussians: int, pixels: int) -> float:
        """Return the least standard deviation of a Gaussian in pixels: thin Gaussians look like stray strokes."""
        return self.width_per_spacing * max(0.0, math.sqrt(pixels / num_gaussians) - self.least_spacing)


# rounding lowers MS-SSIM more than fewer Gaussians do; the least width avoids visible stray strokes
BUDGETS: dict[ObjectiveName, GaussianBudget] = {
    "l2": GaussianBudget(),
    "ms-ssim": GaussianBudget(
        bits_per_gaussian=28.5,
        min_bits_per_gaussian=29.0,
        least_spacing=8.0,
        fit_iterations=500,
        compress_iterations=400,
    ),
}


def budget_of(config: FitConfig) -> GaussianBudget:
    """Return the budget for the objective of a fit."""
    assert config.objective is not None
    return BUDGETS[config.objective]


def min_sigma_of(problem: Problem, num_gaussians: int) -> float:
    """Return the least standard deviation of `num_gaussians` Gaussians, in pixels of the photo."""
    height, width = problem.size
    return max(problem.config.min_sigma, budget_of(problem.config).min_sigma(num_gaussians, height * width))


def reduction_of(min_sigma: float) -> int:
    """Return the factor by which a photo may be reduced if no Gaussian is thinner than `min_sigma`."""
    return max(1, int(min_sigma / _PIXELS_PER_SIGMA))
