"""Region weights of the blocks of a graph, sampled from the windows of tiles with several regions."""

from __future__ import annotations

import numpy as np

from kcgs.functional import RegionMap
from kcgs.kernels.tiles import TILE

from .axis import Axis
from .graph import FLOAT, Graph, Value
from .layout import Group, Integers, Tiles, margin

_STEPS = 65535


class Windows:
    """Samples region weights at the pixels of blocks, whose rows and columns are `down` and `across`."""

    def __init__(self, graph: Graph, tiles: Tiles, down: Axis, across: Axis, regions: RegionMap) -> None:
        soft = self.soft = regions.softness != 0.0
        factor = self.factor = 1 if soft else regions.supersample  # labels along a side of a pixel
        self.g, self.tiles = graph, tiles
        self.side = factor * TILE + 2 * margin(factor)
        self.across = across.weights(factor, margin(factor), soft)
        self.down = graph("Transpose", down.weights(factor, margin(factor), soft), perm=[0, 2, 1])
        self.sides = across.side, down.side

    def weights(self, group: Group, slots: Value, row: Value, col: Value) -> Value:
        """Sample the K region weights of blocks, (B, K, 1, P), column by column.

        `slots`, (B,), are the tiles of the blocks by place in the group, `row` and `col`, (B,), where the blocks are.
        """
        g, sample = self.g, self._soft if self.soft else self._hard
        windows = sample(group.tiles, group.regions)  # [T, K, S, S]
        one = g.constant([1])
        across, down = (
            g("Unsqueeze", g("Gather", w, block), one) for w, block in ((self.across, col), (self.down, row))
        )
        weights = g("MatMul", g("MatMul", across, g("Gather", windows, slots)), down)
        if not self.soft:
            best = g("ReduceMax", weights, one, keepdims=1)
            weights = g("Cast", g("Equal", weights, best), to=FLOAT)
        if self.factor > 1:
            k = g.constant([self.factor])
            split = g("Concat", g.constant([0, group.regions]), self.sides[0], k, self.sides[1], k, axis=0)
            weights = g("ReduceMean", g("Reshape", weights, split), g.constant([3, 5]), keepdims=0)
        return g("Reshape", weights, g.constant([0, 0, 1, -1]))

    def _soft(self, chosen: Integers, regions: int) -> Value:
        """All but the last region's are stored, in 65,535 steps; they sum to one."""
        g = self.g
        windows = [self.tiles.windows[tile].numpy() for tile in chosen.tolist()]
        stored = np.concatenate([window[:-1] for window in windows]).swapaxes(1, 2)
        counts = np.array([len(window) for window in windows])[:, None]
        place = np.arange(regions)
        # which of the stored a region has; the one beyond them is zero
        which = np.where(place < counts - 1, np.cumsum(counts - 1)[:, None] - counts + 1 + place, len(stored))
        masks = g("Cast", g.whole(np.round(stored * _STEPS).astype(np.int64)), to=FLOAT)
        masks = g("Pad", g("Mul", masks, np.float32(1 / _STEPS)), np.array([0, 0, 0, 1, 0, 0]))
        weights = g("Gather", masks, g.whole(which))
        rest = g("Sub", np.float32(1), g("ReduceSum", weights, g.constant([1]), keepdims=1))
        last = g("Cast", g.constant((place == counts - 1)[:, :, None, None]), to=FLOAT)
        return g("Add", weights, g("Mul", rest, last))

    def _hard(self, chosen: Integers, regions: int) -> Value:
        """Labels are stored in as few bits as tell a tile's regions apart."""
        g = self.g
        labels = np.stack([self.tiles.windows[tile].numpy() for tile in chosen.tolist()]).swapaxes(1, 2)
        bits = next(b for b in (1, 2, 4, 8, 16) if regions <= 1 << b)
        count = max(1, 8 // bits)
        places = (1 << bits) ** np.arange(count)
        width = -(-self.side // count) * count
        padded = np.pad(labels, ((0, 0), (0, 0), (0, width - self.side))).reshape(*labels.shape[:2], -1, count)
        packed = g.whole((padded * places).sum(-1))
        unpacked = g("Div", g("Unsqueeze", packed, g.constant([3])), places.astype(np.int32))
        unpacked = g("Mod", unpacked, np.int32(1 << bits))
        unpacked = g("Reshape", unpacked, g.constant([len(chosen), 1, self.side, width]))
        unpacked = g("Slice", unpacked, g.constant([0]), g.constant([self.side]), g.constant([3]))
        return g("Cast", g("Equal", unpacked, np.arange(regions, dtype=np.int32)[:, None, None]), to=FLOAT)
