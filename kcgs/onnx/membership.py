"""The membership of a block's pixels, sampled from the window of its tile: a factor that `blocks` multiplies."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from kcgs.functional import RegionMap
from kcgs.kernels.resampled import TINY

from .axis import Axis, Interpolator
from .blur import BlurredWindows, crisp_windows, cut_windows
from .entries import Storage
from .graph import FLOAT, Graph, Value
from .tiles import WINDOW
from .windows import hard_windows, pack_windows, split_tiles, tile_ids, wide_windows

# pixels that a contour may reach where its blur is computed in the graph
_FARTHEST = 16
# steps per pixel that widths are stored in
_WIDTH_STEPS = 1 << 14


def make_membership(
    storage: Storage, regions: RegionMap, down: Axis, across: Axis, crisp: bool
) -> MembershipSampler | None:
    """Store the windows of a map; None where no tile has several regions.

    Samples lose the blur of pixels, as :class:`kcgs.kernels.Resampled` has it, or with `crisp`, of labels that are
    blurred by the width of one, make contours as narrow as :class:`kcgs.kernels.Crisp` has them.
    """
    g, tiles, membership = storage.graph, storage.plan.tiles, regions.tables.membership
    tiles_of = storage.plan.mixed_tiles
    if not tiles_of:
        return None
    soft = regions.softness != 0.0
    places = Interpolator(down, across, down.sampling(soft), across.sampling(soft), WINDOW)
    pixel = down.step * across.step  # area of one of the output, in pixels of the scene
    q = g.Relu(1 - pixel)  # as the formula of `Resampled` has it
    sampler = partial(MembershipSampler, g, places)
    if not soft:
        return sampler(hard_windows(g, tiles, tiles_of), None)
    if crisp:
        narrow = g.Max(2 / g.Sqrt(pixel), 1.0)
        return sampler(crisp_windows(g, regions, tiles, tiles_of), lambda *_: narrow, crisp=True)
    widths, level = membership.levels
    variance = np.array([widths[0] ** 2], np.float32)
    uniform = _sharpness(g, g.constant(variance), q) if level is None else None  # exponent of a map of one width
    blurred = None if membership.radius > _FARTHEST else BlurredWindows(g, regions, tiles, tiles_of)
    windows = wide_windows(g, tiles, tiles_of) if blurred is None else blurred.unfold
    if uniform is not None:
        return sampler(windows, lambda *_: uniform)
    if blurred is not None and blurred.levels is not None:
        squares = g.constant(np.array(widths, np.float32) ** 2)[blurred.levels]
    else:
        steps = np.round(np.sqrt(membership.variances[0].cpu().numpy()) * _WIDTH_STEPS)
        width = pack_windows(g, cut_windows(tiles, tile_ids(tiles_of), steps)).astype(FLOAT) * (1 / _WIDTH_STEPS)
        squares = width * width
    variances = split_tiles(g, tiles_of, squares)

    def exponent(count: int, slots: Value, row: Value, col: Value) -> Value:
        return _sharpness(g, places.blocks(variances[count][slots], row, col, (1, 1)), q)

    return sampler(windows, exponent)


class MembershipSampler:
    """Samples the memberships in the blocks of tiles with several regions.

    At the size of the scene, windows hold the memberships of its pixels, unless contours are crisp.

    Args:
        g: the graph.
        places: interpolates windows.
        windows: makes those of the tiles with K regions, (T, K, S, S).
        exponent: of the samples in the blocks of tiles: it takes away the blur of pixels, or more of it. It may be
            sampled, too, since pairs of regions have widths of their own. None: contours are hard, and a pixel is of
            the region with the largest sample.
        crisp: whether contours are narrower than those of the windows at every size.
    """

    def __init__(
        self,
        g: Graph,
        places: Interpolator,
        windows: Callable[[int], Value],
        exponent: Callable[[int, Value, Value, Value], Value] | None,
        crisp: bool = False,
    ) -> None:
        self.graph, self.places, self.windows, self.exponent, self.crisp = g, places, windows, exponent, crisp

    def blocks(self, count: int, slots: Value, row: Value, col: Value) -> Value:
        """Sample the memberships in the blocks of tiles with K regions, (T, blocks, K, 1, P), column by column.

        `slots`, (T,), are the places of the tiles among those, `row` and `col`, (T,), those among rows and columns.
        """
        g, places, windows = self.graph, self.places, self.windows(count)[slots]

        def sample() -> Value:
            samples = places.blocks(windows, row, col, (count, 1))
            if self.exponent is None:
                return g.Equal(samples, g.ReduceMax(samples, [2], keepdims=1)).astype(FLOAT)
            return _sharpen(g, samples, self.exponent(count, slots, row, col))

        def cut() -> Value:
            return g.Reshape(g.Slice(windows, [1, 1], [-1, -1], [2, 3]), [0, 1, count, 1, -1])

        return sample() if self.crisp else g.choose(places.is_native, cut, sample)


def _sharpness(g: Graph, variance: Value, q: Value) -> Value:
    """Evaluate `kcgs.kernels.resampled.sharpness` by operators, since q is known only when the graph runs."""
    variance = g.Max(variance, TINY)
    interpolated = variance + q * (1 / 6)
    contour = g.Max(variance - q * (1 / 12), q * (1 / 24))
    return g.Sqrt(interpolated / contour)


def _sharpen(g: Graph, samples: Value, exponent: Value) -> Value:
    """Raise the samples of each pixel to a power, and let them sum to one."""
    samples = g.Max(samples, TINY)  # the last region's is what is left of one, up to rounding
    ratios = samples / g.ReduceMax(samples, [2], keepdims=1)
    powers = g.Exp(g.Log(ratios) * exponent)  # Pow takes four times as long
    return powers / g.ReduceSum(powers, [2], keepdims=1)
