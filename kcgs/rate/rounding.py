"""Gradual rounding: Gaussians are rounded a few at a time, and the others correct the error."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch

from kcgs.codec import Classes, Codes
from kcgs.optim import End, Event, TimedAction, count_iterations, run

from .rate_distortion import RATE, RateDistortionDescent

# These numbers are tuned: change one and compare the files of `python -m benchmarks rate`.

# share of the iterations in which places and shapes are rounded; colours are rounded in the rest
_SHAPE_SHARE = 0.65
# iterations between two groups of Gaussians that are rounded
_GROUP_INTERVAL = 3
# bytes of each of the weakest Gaussians, as a share of the mean over all Gaussians
_WEAK_SHARE = 0.75
# shares of the iterations at which Gaussians are removed if the file is too large: the others have time to correct
# the error
_SIZE_CHECKS = (0.3, 0.65, 0.9)


def round_gradually(
    descent: RateDistortionDescent,
    write: Callable[[Codes], bytes],
    iterations: int,
    seed: int,
    max_bytes: float = math.inf,
) -> bytes:
    """Round all Gaussians of a descent, in a random order, and return their file.

    Gaussians overlap, so the neighbours of a rounded Gaussian can partly correct its error, as long as they are free to
    move. Places and shapes are rounded first, colours last.

    Args:
        descent: has the Gaussians; some are removed from it if the file is too large.
        write: returns the file of the Gaussians of `descent`.
        iterations: steps of the descent; 0: round all at once.
        seed: of the order.
        max_bytes: largest size of the file, unless one Gaussian alone takes more.
    """
    rounding = _Rounding(descent, write, seed, max_bytes)
    times = [k / iterations for k in range(0, iterations, _GROUP_INTERVAL)]
    checks = [min((time for time in times if time >= share), default=math.inf) for share in _SIZE_CHECKS]
    events: list[Event] = [End(), TimedAction(checks, rounding.check_size), TimedAction(times, rounding.round_group)]
    run(descent, descent.step, count_iterations(descent, iterations), events, lambda progress: RATE)
    while len(data := write(rounding.codes())) > max_bytes and len(descent.ids) > 1:
        rounding.remove_excess(len(data))
    return data


class _Rounding:
    """The order in which Gaussians are rounded, and their classes."""

    def __init__(
        self, descent: RateDistortionDescent, write: Callable[[Codes], bytes], seed: int, max_bytes: float
    ) -> None:
        self.descent, self.write, self.max_bytes = descent, write, max_bytes
        self.order = torch.rand(2, len(descent.ids), generator=torch.Generator().manual_seed(seed))
        self.classes = descent.quantizer.classify(descent.parameters())

    def codes(self) -> Codes:
        """Round all current Gaussians."""
        return self.descent.quantizer.quantize(self.descent.parameters(), self.classes)

    def check_size(self) -> None:
        """Remove Gaussians if the file is too large."""
        if self.max_bytes < math.inf:
            self.remove_excess(len(self.write(self.codes())))

    def round_group(self) -> None:
        """Round the Gaussians whose turn it is."""
        descent, progress = self.descent, self.descent.progress
        shape_mask = self.order[0] < progress / _SHAPE_SHARE
        color_mask = self.order[1] < (progress - _SHAPE_SHARE) / (1 - _SHAPE_SHARE)
        descent.round(descent.quantizer.dequantize(self.codes()), shape_mask, color_mask)

    def remove_excess(self, size: int) -> None:
        """Remove the weakest Gaussians if the `size` of their file, in bytes, is too large."""
        rows = self.descent.remove_weakest(_excess(size, self.max_bytes, len(self.descent.ids)))
        self.order, self.classes = self.order[:, rows], Classes(*(numbers[rows] for numbers in self.classes))


def _excess(size: int, max_bytes: float, num_gaussians: int) -> int:
    """Return the number of the weakest Gaussians that take the bytes above `max_bytes`."""
    return max(0, math.ceil((size - max_bytes) * num_gaussians / (_WEAK_SHARE * size)))
