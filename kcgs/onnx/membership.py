"""The memberships at a block's pixels, sampled from the window of its tile: factors on the colours of `blocks`."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from kcgs.maps import sharpness

from .axis import Axis, Interpolator
from .blur import BlurredWindows, cut_windows
from .entries import Storage
from .graph import Graph, Value
from .tiles import WINDOW
from .windows import pack_windows, split_tiles, stored_windows, tile_ids

# largest reach of a contour, in pixels, whose blur is computed in the graph
_FARTHEST = 16
# least weight of a region at a pixel, so that its logarithm is finite
_TINY = 1e-6


def make_membership(storage: Storage, down: Axis, across: Axis) -> MembershipSampler | None:
    """Store the windows of a map; return None if no tile has several regions."""
    g, tiles, tiles_of = storage.graph, storage.plan.tiles, storage.plan.mixed_tiles
    membership, smooth = tiles.membership, tiles.smooth
    if not tiles_of or membership is None or smooth is None:
        return None
    places = Interpolator(down, across, down.sampling(), across.sampling(), WINDOW)
    ratio = 1 / (down.step * across.step)
    widths, width_index = membership.widths, membership.table.width_index
    stored = smooth.radius > _FARTHEST
    windows, smooth_windows = (
        stored_windows(g, m, tiles, tiles_of) if stored else BlurredWindows(g, m, tiles, tiles_of).unfold
        for m in (membership, smooth)
    )
    if width_index is None:
        exponent = sharpness(g.constant(np.array([widths[0] ** 2], np.float32)), ratio)
        return MembershipSampler(g, places, windows, smooth_windows, lambda *_: exponent)
    width = pack_windows(g, cut_windows(tiles, tile_ids(tiles_of), width_index[0].cpu().numpy()))
    variances = split_tiles(g, tiles_of, g.constant(np.array(widths, np.float32) ** 2)[width])

    def sample(count: int, slots: Value, row: Value, col: Value) -> Value:
        return sharpness(places.blocks(variances[count][slots], row, col, (1, 1)), ratio)

    return MembershipSampler(g, places, windows, smooth_windows, sample)


class MembershipSampler:
    """Sample the memberships in the blocks of tiles with several regions, as :class:`kcgs.maps.Resampled` does.

    Args:
        g: the graph.
        places: interpolates windows.
        windows: returns the memberships of tiles with K regions at the size of the scene, (T, K, S, S).
        smooth_windows: returns the weights that are interpolated for other sizes.
        exponent: returns the exponent of the samples in the blocks of tiles.
    """

    def __init__(
        self,
        g: Graph,
        places: Interpolator,
        windows: Callable[[int], Value],
        smooth_windows: Callable[[int], Value],
        exponent: Callable[[int, Value, Value, Value], Value],
    ) -> None:
        self.graph, self.places, self.exponent = g, places, exponent
        self.windows, self.smooth_windows = windows, smooth_windows

    def blocks(self, count: int, slots: Value, row: Value, col: Value) -> Value:
        """Sample the memberships in the blocks of tiles with K regions, (T, blocks, K, 1, P), stored by columns.

        `slots`, (T,), are indices among the tiles with K regions; `row` and `col`, (T,), are those of the tiles.
        """
        g, places = self.graph, self.places
        windows, smooth_windows = self.windows(count)[slots], self.smooth_windows(count)[slots]

        def pan() -> Value:
            return places.blocks(windows, row, col, (count, 1))

        def sample() -> Value:
            samples = places.blocks(smooth_windows, row, col, (count, 1))
            return _sharpen(g, samples, self.exponent(count, slots, row, col))

        def cut() -> Value:
            return g.Reshape(g.Slice(windows, [1, 1], [-1, -1], [2, 3]), [0, 1, count, 1, -1])

        return g.choose(places.is_native, cut, lambda: g.choose(places.is_aligned, pan, sample))


def _sharpen(g: Graph, samples: Value, exponent: Value) -> Value:
    """Raise the samples of each pixel to a power, and normalise them to a sum of 1."""
    samples = g.Max(samples, _TINY)
    ratios = samples / g.ReduceMax(samples, [2], keepdims=1)
    powers = g.Exp(g.Log(ratios) * exponent)  # Pow takes four times as long
    return powers / g.ReduceSum(powers, [2], keepdims=1)
