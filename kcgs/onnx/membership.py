"""The memberships at a block's pixels, sampled from the window of its tile: factors on the colours of `blocks`."""

from __future__ import annotations

import numpy as np

from kcgs.maps import sharpness

from .axis import Axis, Interpolator
from .blur import BlurredWindows, cut_windows
from .entries import Storage
from .graph import Graph, Value
from .tiles import WINDOW
from .windows import StoredWindows, pack_windows, tile_ids

# largest reach of a contour, in pixels, whose blur is computed in the graph
_FARTHEST = 16
# least weight of a region at a pixel, so that its logarithm is finite
_TINY = 1e-6


class MembershipSampler:
    """Sample the memberships in the blocks of tiles with several regions, as :class:`kcgs.maps.Resampled` does."""

    def __init__(self, storage: Storage, down: Axis, across: Axis) -> None:
        """Store the windows of a map with tiles of several regions: at the size of the scene, and for other sizes."""
        g, tiles, tiles_of = storage.graph, storage.plan.tiles, storage.plan.mixed_tiles
        membership, smooth = tiles.membership, tiles.smooth
        assert membership is not None and smooth is not None
        self.graph = g
        self.interpolator = Interpolator(down, across, down.sampling(), across.sampling(), WINDOW)
        self.ratio = 1 / (down.step * across.step)
        make_windows = StoredWindows if smooth.radius > _FARTHEST else BlurredWindows
        self.windows, self.smooth_windows = (make_windows(g, m, tiles, tiles_of) for m in (membership, smooth))
        widths, width_index = membership.widths, membership.table.width_index
        self.exponent: Value | None = None  # of all pixels; None: `variances` of pixels by the number of regions
        self.variances: dict[int, Value] = {}
        if width_index is None:
            self.exponent = sharpness(g.constant(np.array([widths[0] ** 2], np.float32)), self.ratio)
        else:
            width = pack_windows(g, cut_windows(tiles, tile_ids(tiles_of), width_index[0].cpu().numpy()))
            variances = g.constant(np.array(widths, np.float32) ** 2)[width]
            self.variances = dict(zip(tiles_of, g.split(variances, [*map(len, tiles_of.values())]), strict=True))

    def blocks(self, count: int, slots: Value, row: Value, col: Value) -> Value:
        """Sample the memberships in the blocks of tiles with K regions, (T, blocks, K, 1, P), stored by columns.

        `slots`, (T,), are indices among the tiles with K regions; `row` and `col`, (T,), are those of the tiles.
        """
        g, interpolator = self.graph, self.interpolator
        windows, smooth_windows = (part.unfold(count)[slots] for part in (self.windows, self.smooth_windows))

        def pan() -> Value:
            return interpolator.blocks(windows, row, col, (count, 1))

        def sample() -> Value:
            samples = interpolator.blocks(smooth_windows, row, col, (count, 1))
            exponent = self.exponent
            if exponent is None:
                exponent = sharpness(interpolator.blocks(self.variances[count][slots], row, col, (1, 1)), self.ratio)
            return _sharpen(g, samples, exponent)

        def cut() -> Value:
            return g.Reshape(g.Slice(windows, [1, 1], [-1, -1], [2, 3]), [0, 1, count, 1, -1])

        return g.choose(interpolator.is_native, cut, lambda: g.choose(interpolator.is_aligned, pan, sample))


def _sharpen(g: Graph, samples: Value, exponent: Value) -> Value:
    """Raise the samples of each pixel to a power, and normalise them to a sum of 1; docs/method.md has the formula."""
    samples = g.Max(samples, _TINY)
    ratios = samples / g.ReduceMax(samples, [2], keepdims=1)
    powers = g.Exp(g.Log(ratios) * exponent)  # Pow takes four times as long
    return powers / g.ReduceSum(powers, [2], keepdims=1)
