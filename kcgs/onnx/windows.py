"""Windows, tiles and the pixels around them, of hard contours and of very wide ones. Made for `membership`."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .graph import FLOAT, Graph, Value
from .groups import Group, Integers
from .packing import pack_integers, pack_runs
from .tiles import Tiles

# steps between no and full membership that windows of wide contours are stored in: two bytes
_STEPS = (1 << 16) - 1


class HardWindows:
    """Windows of hard contours, stored as labels; groups by their number."""

    def __init__(self, g: Graph, tiles: Tiles, groups: Mapping[int, Group]) -> None:
        self.graph = g
        self.groups = groups
        windows = np.stack([tiles.windows[tile].numpy() for tile in tile_ids(groups).tolist()])
        self.labels = split_groups(g, groups, pack_windows(g, windows))

    def unfold(self, number: int) -> Value:
        """Unfold the windows of a group, (T, K, S, S)."""
        g, ids = self.graph, np.arange(self.groups[number].regions, dtype=np.int32)
        return g.Equal(g.Unsqueeze(self.labels[number], [1]), ids[:, None, None]).astype(FLOAT)


class WideWindows:
    """Windows of contours that are too wide to be blurred in the graph, stored as memberships."""

    def __init__(self, g: Graph, tiles: Tiles, groups: Mapping[int, Group]) -> None:
        self.graph = g
        self.tiles = tiles
        self.groups = groups

    def unfold(self, number: int) -> Value:
        """Unfold the windows of a group, (T, K, S, S): all but the last region's are stored; they sum to one."""
        g, group = self.graph, self.groups[number]
        windows = [self.tiles.windows[tile].numpy() for tile in group.tiles.tolist()]
        memberships = np.concatenate([window[:-1] for window in windows]).swapaxes(1, 2)
        counts = np.array([len(window) for window in windows])[:, None]
        place = np.arange(group.regions)
        # place of a region's membership; the last place is that of zeros
        ids = np.where(place < counts - 1, np.cumsum(counts - 1)[:, None] - counts + 1 + place, len(memberships))
        masks = pack_integers(g, np.round(memberships * _STEPS).astype(np.int64)).astype(FLOAT)
        masks = g.Pad(masks * (1 / _STEPS), [0, 0, 0, 1, 0, 0])
        weights = masks[pack_integers(g, ids)]
        remainder = 1 - g.ReduceSum(weights, [1], keepdims=1)
        last = g.constant((place == counts - 1)[:, :, None, None]).astype(FLOAT)
        return weights + remainder * last


def tile_ids(groups: Mapping[int, Group]) -> Integers:
    """Tiles of all groups, (T,)."""
    return np.concatenate([group.tiles for group in groups.values()])


def split_groups(g: Graph, groups: Mapping[int, Group], values: Value) -> dict[int, Value]:
    """Cut values of all tiles, (T, ...), into those of each group."""
    lengths = [len(group.tiles) for group in groups.values()]
    return dict(zip(groups, g.split(values, lengths), strict=True))


def pack_windows(g: Graph, windows: Integers) -> Value:
    """Store integers (T, S, S), column by column."""
    return g.Reshape(pack_runs(g, windows.swapaxes(1, 2).ravel()), windows.shape)
