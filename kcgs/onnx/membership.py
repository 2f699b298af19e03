"""The membership of a block's pixels, sampled from the window of its tile: a factor that `blocks` multiplies."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from kcgs.functional import RegionMap
from kcgs.kernels.resampled import TINY

from .axis import Axis
from .blur import BlurredWindows, CrispWindows, cut_windows
from .entries import Storage
from .graph import FLOAT, Graph, Value
from .windows import HardWindows, WideWindows, pack_windows, split_groups, tile_ids

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
    groups = {number: group for number, group in enumerate(storage.plan.groups) if group.regions > 1}
    if not groups:
        return None
    soft = regions.softness != 0.0
    columns = across.sampling(soft)
    rows = g.Transpose(down.sampling(soft), perm=[0, 2, 1])
    pixel = down.step * across.step  # area of one of the output, in pixels of the scene
    q = g.Relu(1 - pixel)  # as the formula of `Resampled` has it
    if not soft:
        return MembershipSampler(g, rows, columns, HardWindows(g, tiles, groups))
    if crisp:
        exponent = g.Max(2 / g.Sqrt(pixel), 1.0)
        return SoftSampler(g, rows, columns, CrispWindows(g, regions, tiles, groups), exponent)
    widths, level = membership.levels
    variance = np.array([widths[0] ** 2], np.float32)
    uniform = _sharpness(g, g.constant(variance), q) if level is None else None  # exponent of a map of one width
    wide = membership.radius > _FARTHEST
    blurred = None if wide else BlurredWindows(g, regions, tiles, groups)
    windows = blurred or WideWindows(g, tiles, groups)
    if uniform is not None:
        return SoftSampler(g, rows, columns, windows, uniform)
    if blurred is not None and blurred.levels is not None:
        squares = g.constant(np.array(widths, np.float32) ** 2)[blurred.levels]
    else:
        steps = np.round(np.sqrt(membership.variances[0].cpu().numpy()) * _WIDTH_STEPS)
        width = pack_windows(g, cut_windows(tiles, tile_ids(groups), steps)).astype(FLOAT) * (1 / _WIDTH_STEPS)
        squares = width * width
    return PairSampler(g, rows, columns, windows, split_groups(g, groups, squares), q)


class Windows(Protocol):
    """The windows of groups, by their number."""

    def unfold(self, number: int) -> Value:
        """Unfold the windows of a group, (T, K, S, S)."""


class MembershipSampler:
    """Memberships in a map of hard contours: a pixel is of the region with the largest sample.

    `down` and `across` are bilinear weights of windows at the pixels of blocks, (blocks, S, side), (blocks, side, S).
    """

    def __init__(self, g: Graph, down: Value, across: Value, windows: Windows) -> None:
        self.graph = g
        self.down = down
        self.across = across
        self.windows = windows

    def blocks(self, group: int, slots: Value, row: Value, col: Value) -> Value:
        """Sample the memberships of blocks of a group, (B, K, 1, P), column by column.

        `slots`, (B,), are the tiles of the blocks by place in the group, `row` and `col`, (B,), where the blocks are.
        """
        g, windows = self.graph, self.windows.unfold(group)
        across, down = (g.Unsqueeze(w[block], [1]) for w, block in ((self.across, col), (self.down, row)))
        samples = across @ windows[slots] @ down
        return g.Reshape(self._normalize(samples, group, slots, across, down), [0, 0, 1, -1])

    def _normalize(self, samples: Value, group: int, slots: Value, across: Value, down: Value) -> Value:
        """Make memberships that sum to one, (B, K, side, side)."""
        return self.graph.Equal(samples, self.graph.ReduceMax(samples, [1], keepdims=1)).astype(FLOAT)


class SoftSampler(MembershipSampler):
    """Memberships in a map of one width: samples to a power, which takes the blur of pixels away, or more of it."""

    def __init__(self, g: Graph, down: Value, across: Value, windows: Windows, exponent: Value) -> None:
        super().__init__(g, down, across, windows)
        self.exponent = exponent

    def _normalize(self, samples: Value, group: int, slots: Value, across: Value, down: Value) -> Value:
        return _sharpen(self.graph, samples, self.exponent)


class PairSampler(MembershipSampler):
    """Memberships in a map whose pairs of regions have widths of their own: exponents are sampled, too."""

    def __init__(
        self, g: Graph, down: Value, across: Value, windows: Windows, variances: dict[int, Value], q: Value
    ) -> None:
        super().__init__(g, down, across, windows)
        self.variances = variances  # of each group, (T, S, S), squares of widths
        self.q = q  # share of a pixel's blur that interpolation loses

    def _normalize(self, samples: Value, group: int, slots: Value, across: Value, down: Value) -> Value:
        g = self.graph
        variance = self.variances[group][slots]
        variance = g.Squeeze(across, [1]) @ variance @ g.Squeeze(down, [1])
        return _sharpen(g, samples, _sharpness(g, g.Unsqueeze(variance, [1]), self.q))


def _sharpness(g: Graph, variance: Value, q: Value) -> Value:
    """Evaluate `kcgs.kernels.resampled.sharpness` by operators, since q is known only when the graph runs."""
    variance = g.Max(variance, TINY)
    interpolated = variance + q * (1 / 6)
    contour = g.Max(variance - q * (1 / 12), q * (1 / 24))
    return g.Sqrt(interpolated / contour)


def _sharpen(g: Graph, samples: Value, exponent: Value) -> Value:
    """Raise the samples of each pixel to a power, and let them sum to one."""
    samples = g.Relu(samples)  # the last region's is what is left of one, up to rounding
    powers = g.Pow(samples / g.ReduceMax(samples, [1], keepdims=1), exponent)
    return powers / g.ReduceSum(powers, [1], keepdims=1)
