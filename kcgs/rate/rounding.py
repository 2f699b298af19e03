"""Gradual rounding: Gaussians are rounded a few at a time, and the others correct the error."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch

from kcgs.codec.gaussians.quantize import Classes, Codes, Quantizer

from .descent import RateDistortionDescent

# Numbers are tuned: vary one and compare the files of `python -m benchmarks rate`.

# share of the iterations in which places and shapes are rounded; colours are rounded in the rest
_SHAPE_SHARE = 0.65
# iterations from one group of Gaussians that is rounded to the next
_GROUP_INTERVAL = 3
# bytes of one of the weakest Gaussians, as a share of the mean
_WEAK_SHARE = 0.75
# shares of the iterations after which Gaussians are removed if the file is too large: early enough that the others
# correct the error
_SIZE_CHECKS = (0.3, 0.65, 0.9)


def round_gradually(
    descent: RateDistortionDescent,
    quantizer: Quantizer,
    write: Callable[[Codes], bytes],
    iterations: int,
    seed: int,
    max_bytes: float = math.inf,
) -> bytes:
    """Round all Gaussians of a descent, in an order of the seed, and return their file.

    Gaussians overlap, so the neighbours of one that is rounded can partly correct its error, as long as they are free
    to move. Places and shapes are rounded first, colours last.

    Args:
        descent: of the Gaussians, which are removed from it where the file is too large.
        quantizer: of the file.
        write: returns the file of the Gaussians of `descent`.
        iterations: steps of the descent; 0: round all at once.
        seed: of the order.
        max_bytes: largest size of the file, unless one Gaussian alone takes more.
    """
    order = torch.rand(2, len(descent.ids), generator=torch.Generator().manual_seed(seed))
    classes = quantizer.classify(descent.parameters())
    checks = [*_SIZE_CHECKS, math.inf]
    for iteration in range(iterations):
        progress = iteration / iterations
        if iteration % _GROUP_INTERVAL == 0:
            codes = quantizer.quantize(descent.parameters(), classes)
            if progress >= checks[0] and max_bytes < math.inf:
                checks.pop(0)
                rows = descent.remove_weakest(_excess(len(write(codes)), max_bytes, len(descent.ids)))
                order, classes = order[:, rows], Classes(*(numbers[rows] for numbers in classes))
                codes = quantizer.quantize(descent.parameters(), classes)
            rounded_values = quantizer.dequantize(codes)
            shape_mask = order[0] < progress / _SHAPE_SHARE
            color_mask = order[1] < (progress - _SHAPE_SHARE) / (1 - _SHAPE_SHARE)
        descent.step_around(rounded_values, shape_mask, color_mask, quantizer)
    while len(data := write(quantizer.quantize(descent.parameters(), classes))) > max_bytes and len(descent.ids) > 1:
        rows = descent.remove_weakest(_excess(len(data), max_bytes, len(descent.ids)))
        classes = Classes(*(numbers[rows] for numbers in classes))
    return data


def _excess(size: int, max_bytes: float, num_gaussians: int) -> int:
    """Return how many of the weakest Gaussians the bytes above `max_bytes` are for."""
    return max(0, math.ceil((size - max_bytes) * num_gaussians / (_WEAK_SHARE * size)))
