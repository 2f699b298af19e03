"""Windows (tiles with the pixels around them), for `membership`: integers, and memberships of very wide contours."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch

from kcgs.maps import Membership

from .graph import FLOAT, Graph, Value
from .groups import Integers
from .packing import pack_integers, pack_runs
from .tiles import Tiles, read_memberships

# number of steps of the stored weights of wide contours, up to the largest weight: two bytes
_STEPS = (1 << 16) - 1


class StoredWindows:
    """Windows of contours that are too wide for a blur in the graph; `tiles_of` as in `BlurredWindows`."""

    def __init__(self, g: Graph, membership: Membership, tiles: Tiles, tiles_of: Mapping[int, Integers]) -> None:
        self.graph, self.membership, self.tiles, self.tiles_of = g, membership, tiles, tiles_of

    def unfold(self, count: int) -> Value:
        """Store the windows of tiles with K regions, (T, K, S, S), by columns."""
        ids, tiles = self.tiles_of[count].tolist(), self.tiles
        counts = [len(tiles.regions[tile]) for tile in ids]
        tile = torch.tensor(ids).repeat_interleave(torch.tensor(counts))
        region = torch.tensor([region for tile in ids for region in tiles.regions[tile]])
        weights = read_memberships(self.membership, tile, tiles.cols, region).numpy().swapaxes(1, 2)
        windows = np.zeros((len(ids), count, *weights.shape[1:]))
        windows[np.arange(count) < np.array(counts)[:, None]] = weights
        step = max(float(windows.max()), 1e-9) / _STEPS
        return pack_integers(self.graph, np.round(windows / step).astype(np.int64)).astype(FLOAT) * step


def tile_ids(tiles_of: Mapping[int, Integers]) -> Integers:
    """Return the tiles with several regions, (T,)."""
    return np.concatenate([*tiles_of.values()])


def pack_windows(g: Graph, windows: Integers) -> Value:
    """Store integers (T, S, S) of windows by columns."""
    return g.Reshape(pack_runs(g, windows.swapaxes(1, 2).ravel()), windows.shape)
