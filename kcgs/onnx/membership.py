"""The membership of a block's pixels, sampled from the window of its tile: a factor that `blocks` multiplies."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from kcgs.functional import RegionMap
from kcgs.kernels.resampled import TINY

from .axis import Axis, Interpolator
from .blur import BlurredWindows, CrispWindows, cut_windows
from .entries import Storage
from .graph import FLOAT, Graph, Value
from .tiles import WINDOW
from .windows import HardWindows, WideWindows, pack_windows, split_tiles, tile_ids

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
    if not soft:
        return MembershipSampler(g, places, HardWindows(g, tiles, tiles_of))
    if crisp:
        exponent = g.Max(2 / g.Sqrt(pixel), 1.0)
        return CrispSampler(g, places, CrispWindows(g, regions, tiles, tiles_of), exponent)
    widths, level = membership.levels
    variance = np.array([widths[0] ** 2], np.float32)
    uniform = _sharpness(g, g.constant(variance), q) if level is None else None  # exponent of a map of one width
    wide = membership.radius > _FARTHEST
    blurred = None if wide else BlurredWindows(g, regions, tiles, tiles_of)
    windows = blurred or WideWindows(g, tiles, tiles_of)
    if uniform is not None:
        return SoftSampler(g, places, windows, uniform)
    if blurred is not None and blurred.levels is not None:
        squares = g.constant(np.array(widths, np.float32) ** 2)[blurred.levels]
    else:
        steps = np.round(np.sqrt(membership.variances[0].cpu().numpy()) * _WIDTH_STEPS)
        width = pack_windows(g, cut_windows(tiles, tile_ids(tiles_of), steps)).astype(FLOAT) * (1 / _WIDTH_STEPS)
        squares = width * width
    return PairSampler(g, places, windows, split_tiles(g, tiles_of, squares), q)


class Windows(Protocol):
    """The windows of tiles with several regions."""

    def unfold(self, count: int) -> Value:
        """Unfold the windows of the tiles with K regions, (T, K, S, S)."""


class MembershipSampler:
    """Memberships in a map of hard contours: a pixel is of the region with the largest sample.

    At the size of the scene, windows hold the memberships of its pixels, unless contours are crisp.
    """

    crisp = False

    def __init__(self, g: Graph, places: Interpolator, windows: Windows) -> None:
        self.graph = g
        self.places = places
        self.windows = windows

    def blocks(self, count: int, slots: Value, row: Value, col: Value) -> Value:
        """Sample the memberships in the blocks of tiles with K regions, (T, blocks, K, 1, P), column by column.

        `slots`, (T,), are the places of the tiles among those, `row` and `col`, (T,), those among rows and columns.
        """
        g, places, windows = self.graph, self.places, self.windows.unfold(count)[slots]

        def sample() -> Value:
            return self._normalize(places.blocks(windows, row, col, (count, 1)), count, slots, row, col)

        def cut() -> Value:
            return g.Reshape(g.Slice(windows, [1, 1], [-1, -1], [2, 3]), [0, 1, count, 1, -1])

        return sample() if self.crisp else g.choose(places.is_native, cut, sample)

    def _normalize(self, samples: Value, count: int, slots: Value, row: Value, col: Value) -> Value:
        """Make memberships that sum to one."""
        return self.graph.Equal(samples, self.graph.ReduceMax(samples, [2], keepdims=1)).astype(FLOAT)


class SoftSampler(MembershipSampler):
    """Memberships in a map of one width: samples to a power, which takes the blur of pixels away, or more of it."""

    def __init__(self, g: Graph, places: Interpolator, windows: Windows, exponent: Value) -> None:
        super().__init__(g, places, windows)
        self.exponent = exponent

    def _normalize(self, samples: Value, count: int, slots: Value, row: Value, col: Value) -> Value:
        return _sharpen(self.graph, samples, self.exponent)


class CrispSampler(SoftSampler):
    """Memberships whose contours are narrower than those of the windows at every size."""

    crisp = True


class PairSampler(MembershipSampler):
    """Memberships in a map whose pairs of regions have widths of their own: exponents are sampled, too."""

    def __init__(self, g: Graph, places: Interpolator, windows: Windows, variances: dict[int, Value], q: Value) -> None:
        super().__init__(g, places, windows)
        self.variances = variances  # (T, S, S), squares of widths
        self.q = q  # share of a pixel's blur that interpolation loses

    def _normalize(self, samples: Value, count: int, slots: Value, row: Value, col: Value) -> Value:
        g = self.graph
        variance = self.places.blocks(self.variances[count][slots], row, col, (1, 1))
        return _sharpen(g, samples, _sharpness(g, variance, self.q))


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
