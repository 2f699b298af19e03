"""Windows, tiles and the pixels around them, of hard contours and of very wide ones. Made for `membership`."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from .graph import FLOAT, Graph, Value
from .groups import Integers
from .packing import pack_integers, pack_runs
from .tiles import Tiles

# steps between no and full membership that windows of wide contours are stored in: two bytes
_STEPS = (1 << 16) - 1


def hard_windows(g: Graph, tiles: Tiles, tiles_of: Mapping[int, Integers]) -> Callable[[int], Value]:
    """Store windows of hard contours as labels; return what makes those of the tiles with K regions, (T, K, S, S)."""
    windows = np.stack([tiles.windows[tile].numpy() for tile in tile_ids(tiles_of).tolist()])
    labels = split_tiles(g, tiles_of, pack_windows(g, windows))

    def unfold(count: int) -> Value:
        ids = np.arange(count, dtype=np.int32)
        return g.Equal(g.Unsqueeze(labels[count], [1]), ids[:, None, None]).astype(FLOAT)

    return unfold


def wide_windows(g: Graph, tiles: Tiles, tiles_of: Mapping[int, Integers]) -> Callable[[int], Value]:
    """Return what makes windows, (T, K, S, S), of contours that are too wide to be blurred in the graph.

    Memberships are stored, of all but the last region, since they sum to one.
    """

    def unfold(count: int) -> Value:
        windows = [tiles.windows[tile].numpy() for tile in tiles_of[count].tolist()]
        memberships = np.concatenate([window[:-1] for window in windows]).swapaxes(1, 2)
        counts = np.array([len(window) for window in windows])[:, None]
        place = np.arange(count)
        # place of a region's membership; the last place is that of zeros
        ids = np.where(place < counts - 1, np.cumsum(counts - 1)[:, None] - counts + 1 + place, len(memberships))
        masks = pack_integers(g, np.round(memberships * _STEPS).astype(np.int64)).astype(FLOAT)
        masks = g.Pad(masks * (1 / _STEPS), [0, 0, 0, 1, 0, 0])
        weights = masks[pack_integers(g, ids)]
        remainder = 1 - g.ReduceSum(weights, [1], keepdims=1)
        last = g.constant((place == counts - 1)[:, :, None, None]).astype(FLOAT)
        return weights + remainder * last

    return unfold


def tile_ids(tiles_of: Mapping[int, Integers]) -> Integers:
    """Tiles with several regions, (T,)."""
    return np.concatenate([*tiles_of.values()])


def split_tiles(g: Graph, tiles_of: Mapping[int, Integers], values: Value) -> dict[int, Value]:
    """Cut values of all tiles, (T, ...), by the number of regions."""
    lengths = [len(tiles) for tiles in tiles_of.values()]
    return dict(zip(tiles_of, g.split(values, lengths), strict=True))


def pack_windows(g: Graph, windows: Integers) -> Value:
    """Store integers (T, S, S), column by column."""
    return g.Reshape(pack_runs(g, windows.swapaxes(1, 2).ravel()), windows.shape)
