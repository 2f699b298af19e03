"""Gradual rounding: Gaussians are rounded a few at a time, and the others correct the error."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch

from kcgs.codec.gaussians.quantize import Classes, Codes, Quantizer

from .descent import RateDistortionDescent

# Tuned: vary one and compare the files of `python -m benchmarks rate`.

# share of the iterations in which places and shapes are rounded; colours follow
_SHAPE_SHARE = 0.65
# iterations between two groups of Gaussians that are rounded
_GROUP_INTERVAL = 3
# shares of the iterations after which the file is measured, and Gaussians in excess of its size are removed: early
# enough that the others replace them
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
        descent: the Gaussians.
        quantizer: of the file.
        write: makes the file of the Gaussians of the moment.
        iterations: steps of the descent; 0: round all at once.
        seed: of the order.
        max_bytes: size of the file, which the weakest Gaussians are removed for; one Gaussian stays.
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
            rounded = quantizer.dequantize(codes)
            rounded_shapes = order[0] < progress / _SHAPE_SHARE
            rounded_colors = order[1] < (progress - _SHAPE_SHARE) / (1 - _SHAPE_SHARE)
        descent.step_around(rounded, rounded_shapes, rounded_colors, quantizer)
    while len(data := write(quantizer.quantize(descent.parameters(), classes))) > max_bytes and len(descent.ids) > 1:
        rows = descent.remove_weakest(_excess(len(data), max_bytes, len(descent.ids)))
        classes = Classes(*(numbers[rows] for numbers in classes))
    return data


def _excess(size: int, max_bytes: float, num_gaussians: int) -> int:
    """Return the number of Gaussians that take the bytes above `max_bytes`."""
    return max(0, math.ceil((size - max_bytes) * num_gaussians / size))
