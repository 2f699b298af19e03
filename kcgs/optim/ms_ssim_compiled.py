"""The objective `ms-ssim` on the CPU: the arrays and the tasks of its compiled loops.

On one core a gradient at 480p takes 2.4 ms, with torch operations 18 ms.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kcgs.compiled.tasks import phases, run_tasks
from kcgs.functional import window_taps

from .ms_ssim_loops import CHANNEL, HALVE, HEIGHT, MARGIN, PADDING, SCALE, SCORE, SUM, WIDTH, Scales, run_phases

# rows of the finest scale per task, a multiple of the rows of a block of the coarsest scale
_ROWS = 64


class CompiledMsSsim:
    """The objective and its gradient at differences from an image, or from each of a batch.

    Args:
        scales: for each scale the images, (B C, h, w), the inverse of the window's sum inside the image, (1, h, w),
            mean and variance under the window, (B C, h, w).
        factors: weight of each scale over the norm of each image, (S, B).
        least: least mean score of a scale.
    """

    def __init__(self, scales: Sequence[Sequence[NDArray[Any]]], factors: NDArray[Any], least: float) -> None:
        self._channels, self._num_images = len(scales[0][0]), factors.shape[1]
        sizes = np.array([scale[0].shape[1:] for scale in scales])
        padded_sizes = sizes + np.array([PADDING, 2 * MARGIN])
        areas = np.column_stack([side.prod(1) for side in (sizes, padded_sizes, (sizes + 1) // 2)])
        table, taps = np.column_stack([sizes, areas.cumsum(0) - areas]), np.array(window_taps(), np.float32)
        sides = (0, 0), (MARGIN, PADDING - MARGIN), (MARGIN, MARGIN)
        image = np.concatenate([np.pad(scale[0], sides).ravel() for scale in scales])
        inside, mean, variance = (
            np.concatenate([scale[k][:, ::2, ::2].ravel() for scale in scales]) for k in (1, 2, 3)
        )
        # `factors` are for windows at all pixels; the loops take windows at even rows and columns
        weights = (factors.repeat(self._channels // factors.shape[1], 1).T * areas[:, 0] / areas[:, 2]).T.copy()
        render, planes = np.zeros_like(image), np.empty(self._channels * areas[:, 0].sum(), np.float32)
        settings = table, self._channels, weights, least, taps
        self._scales = Scales(*settings, image, inside, mean, variance, render, planes)
        bands = self._bands(0)
        rows = np.concatenate([self._bands(scale) for scale in range(len(sizes))])
        steps = [(HALVE, bands), (SCORE, rows), (SUM, bands)]
        parts = [np.column_stack([np.full(len(part), phase), part]) for phase, part in steps]
        self._value_tasks, self._tasks = phases(*parts[:2]), phases(*parts)

    def _bands(self, scale: int) -> NDArray[np.int64]:
        """Return the tasks of a scale: scale, channel, first row, last + 1."""
        height = int(self._scales.table[scale, HEIGHT])
        firsts = range(0, height, _ROWS)
        return np.array([(scale, c, y, min(y + _ROWS, height)) for c in range(self._channels) for y in firsts])

    def value(self, difference: NDArray[Any]) -> NDArray[Any]:
        """Return the negative weighted logarithm of MS-SSIM, summed over pixels, averaged over channels, (B,)."""
        sums, table = self._run(difference, self._value_tasks), self._scales.table
        scores = np.zeros((len(table), self._channels))
        np.add.at(scores, (self._value_tasks[:, SCALE], self._value_tasks[:, CHANNEL]), sums)
        windows = ((table[:, [HEIGHT, WIDTH]] + 1) // 2).prod(1)
        logs = np.log(np.maximum(scores / windows[:, None], self._scales.least))
        logs = logs.reshape(len(table), self._num_images, -1).mean(2)
        factors = self._scales.factors[:, :: self._channels // self._num_images]
        areas = 4.0 ** np.arange(1, len(table) + 1)[:, None]
        totals: NDArray[Any] = -(factors * areas * windows[:, None] * logs).sum(0)
        return totals

    def differentiate(self, difference: NDArray[Any], squared: float) -> None:
        """Replace a difference, (B C, H, W), contiguous float32, by half the gradient plus `squared` times itself."""
        self._run(difference, self._tasks, squared)

    def _run(self, difference: NDArray[Any], tasks: Any, squared: float = 0.0) -> NDArray[Any]:
        """Run tasks; return the sums of scores, by task."""
        sums = np.zeros(len(tasks))
        arguments = self._scales, difference, squared, sums, tasks is self._tasks
        run_tasks(lambda tasks, counters: run_phases(*arguments, tasks, counters), tasks)
        return sums
