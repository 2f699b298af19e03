"""Region weights of the blocks of a graph, sampled from the windows of tiles with several regions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from kcgs.functional import RegionMap
from kcgs.kernels.resampled import MARGIN, TINY
from kcgs.kernels.tiles import TILE

from .axis import Axis
from .graph import FLOAT, Graph, Value
from .layout import Group, Integers, Tiles

F32 = np.float32
_STEPS, _FINE_STEPS = (1 << 16) - 1, (1 << 24) - 1  # the latter of weights that are raised to high powers
_FARTHEST = 16  # pixels that a contour reaches where its blur is computed in the graph
_SOFT = TILE + 2  # side of a window of weights
_WIDTHS = 1 << 14  # steps per pixel that widths are stored in


class Windows:
    """Samples region weights at the pixels of blocks, whose rows and columns are `down` and `across`.

    Windows are made when the decoder is loaded: of hard contours they are stored as labels; soft ones are the blur of
    labels, or stored as weights where contours are very wide. What is sampled loses the blur of
    pixels, as :class:`kcgs.kernels.Resampled` has it, or with `crisp`, of labels that are blurred by the width of one,
    becomes as narrow as :class:`kcgs.kernels.Crisp` has it.
    """

    def __init__(
        self,
        graph: Graph,
        tiles: Tiles,
        groups: Sequence[Group],
        down: Axis,
        across: Axis,
        regions: RegionMap,
        crisp: bool = False,
    ) -> None:
        g, soft = graph, regions.softness != 0.0
        self.g, self.soft, self.tiles, self.map = graph, soft, tiles, regions
        self.across = across.weights(soft)
        self.down = g("Transpose", down.weights(soft), perm=[0, 2, 1])
        self._is_crisp = crisp
        self._exponent: Value | None = None
        self._levels: Value | None = None
        self._owns: Sequence[Value] | None = None
        self._variances: Sequence[Value] | None = None
        pixel = g("Mul", down.step, across.step)  # of the output, in pixels of the scene
        self._lost = g("Relu", g("Sub", F32(1), pixel))
        (width, *_), level = regions.membership.levels
        if crisp:
            self._exponent = g("Max", g("Div", F32(2), g("Sqrt", pixel)), F32(1))
        elif soft and level is None:
            self._exponent = self._sharpness(g.constant(np.array([width**2], F32)))
        mixed = [group for group in groups if group.regions > 1]
        self._numbers = {id(group): number for number, group in enumerate(mixed)}
        chosen = np.concatenate([group.tiles for group in mixed])
        self._reach = regions.membership.radius
        blurred = self._reach <= _FARTHEST
        self._sample = (self._blurred if blurred else self._soft) if soft else self._hard
        self._store(chosen, [len(group.tiles) for group in mixed], crisp)

    def _store(self, chosen: Integers, counts: Sequence[int], crisp: bool) -> None:
        """Make what is sampled, or how it is: of all tiles with several regions, whose groups have so many."""
        g, membership = self.g, self.map.membership
        if not self.soft:
            labels = self._piecewise(np.stack([self.tiles.windows[tile].numpy() for tile in chosen.tolist()]))
            self._labels = g.split(labels, counts)
            return
        if self._sample == self._blurred:
            self._blurs = self._blur(chosen)
            if crisp:
                labels = self._piecewise(self._cut(membership.index[0].cpu().numpy(), chosen))
                self._owns = g.split(labels, counts)
        if self._exponent is not None:
            return
        if self._levels is not None:
            squares = g("Gather", g.constant(np.array(membership.levels.widths, F32) ** 2), self._levels)
        else:
            steps = np.round(np.sqrt(membership.variances[0].cpu().numpy()) * _WIDTHS)
            widths = g("Mul", g("Cast", self._piecewise(self._cut(steps, chosen)), to=FLOAT), F32(1 / _WIDTHS))
            squares = g("Mul", widths, widths)
        self._variances = g.split(squares, counts)

    def weights(self, group: Group, slots: Value, row: Value, col: Value) -> Value:
        """Sample the K region weights of blocks, (B, K, 1, P), column by column.

        `slots`, (B,), are the tiles of the blocks by place in the group, `row` and `col`, (B,), where the blocks are.
        """
        g = self.g
        windows = self._sample(group)
        one = g.constant([1])
        across, down = (
            g("Unsqueeze", g("Gather", w, block), one) for w, block in ((self.across, col), (self.down, row))
        )
        weights = g("MatMul", g("MatMul", across, g("Gather", windows, slots)), down)
        if not self.soft:
            best = g("ReduceMax", weights, one, keepdims=1)
            weights = g("Cast", g("Equal", weights, best), to=FLOAT)
        else:
            exponent = self._exponent
            if self._variances is not None:
                squares = g("Gather", self._variances[self._numbers[id(group)]], slots)
                squares = g("MatMul", g("MatMul", g("Squeeze", across, one), squares), g("Squeeze", down, one))
                exponent = self._sharpness(g("Unsqueeze", squares, one))
            assert exponent is not None
            weights = g("Relu", weights)  # the last region's is what is left of one, up to rounding
            powers = g("Pow", g("Div", weights, g("ReduceMax", weights, one, keepdims=1)), exponent)
            weights = g("Div", powers, g("ReduceSum", powers, one, keepdims=1))
        return g("Reshape", weights, g.constant([0, 0, 1, -1]))

    def _sharpness(self, variance: Value) -> Value:
        """Evaluate `kcgs.kernels.resampled.sharpness`, which is 1 where nothing is lost."""
        g = self.g
        variance = g("Max", variance, F32(TINY))
        most = g("Add", variance, g("Mul", self._lost, F32(1 / 6)))
        least = g("Max", g("Sub", variance, g("Mul", self._lost, F32(1 / 12))), g("Mul", self._lost, F32(1 / 24)))
        return g("Sqrt", g("Div", most, least))

    def _piecewise(self, windows: Integers) -> Value:
        """Store windows (T, S, S), column by column."""
        flat = windows.swapaxes(1, 2).ravel()
        return self.g("Reshape", self.g.piecewise(flat), self.g.constant(windows.shape))

    def _hard(self, group: Group) -> Value:
        g = self.g
        labels = g("Unsqueeze", self._labels[self._numbers[id(group)]], g.constant([1]))
        return g("Cast", g("Equal", labels, np.arange(group.regions, dtype=np.int32)[:, None, None]), to=FLOAT)

    def _soft(self, group: Group) -> Value:
        """All but the last region's are stored, in steps; they sum to one."""
        g = self.g
        windows = [self.tiles.windows[tile].numpy() for tile in group.tiles.tolist()]
        stored = np.concatenate([window[:-1] for window in windows]).swapaxes(1, 2)
        counts = np.array([len(window) for window in windows])[:, None]
        place = np.arange(group.regions)
        # which of the stored a region has; the one beyond them is zero
        which = np.where(place < counts - 1, np.cumsum(counts - 1)[:, None] - counts + 1 + place, len(stored))
        steps = _FINE_STEPS if self._is_crisp else _STEPS
        masks = g("Cast", g.whole(np.round(stored * steps).astype(np.int64)), to=FLOAT)
        masks = g("Pad", g("Mul", masks, F32(1 / steps)), np.array([0, 0, 0, 1, 0, 0]))
        weights = g("Gather", masks, g.whole(which))
        rest = g("Sub", F32(1), g("ReduceSum", weights, g.constant([1]), keepdims=1))
        last = g("Cast", g.constant((place == counts - 1)[:, :, None, None]), to=FLOAT)
        return g("Add", weights, g("Mul", rest, last))

    def _blurred(self, group: Group) -> Value:
        """Pick the blurred windows of a group, (T, K, S, S): the sum over the widths of a window, normalised."""
        g, one = self.g, self.g.constant([1])
        most = max(self._widths[tile] for tile in group.tiles.tolist())
        places = np.zeros((len(group.tiles), group.regions, most), np.int64)
        for place, tile in zip(places, group.tiles.tolist(), strict=True):
            count, widths = len(self.tiles.regions[tile]), self._widths[tile]
            place[:count, :widths] = self._firsts[tile] + np.arange(count * widths).reshape(count, widths)
        windows = g("Gather", self._blurs, g.whole(places if most > 1 else places[:, :, 0]))
        windows = g("ReduceSum", windows, g.constant([2]), keepdims=0) if most > 1 else windows
        # beyond the map there is no label, and nothing weighs
        windows = g("Div", windows, g("Max", g("ReduceSum", windows, one, keepdims=1), F32(1e-30)))
        if self._owns is None:
            return windows
        number, best = self._numbers[id(group)], g("ReduceMax", windows, one, keepdims=1)
        ids = np.full((len(group.tiles), group.regions, 1, 1), -1, np.int32)
        for row, tile in zip(ids[..., 0, 0], group.tiles.tolist(), strict=True):
            row[: len(self.tiles.regions[tile])] = self.tiles.regions[tile]
        own = g("And", g("Equal", g("Unsqueeze", self._owns[number], one), ids), g("Less", windows, best))
        return g("Where", own, g("Add", best, F32(MARGIN)), windows)

    def _cut(self, grid: Integers, chosen: Integers) -> Integers:
        """Cut windows, (T, S, S), out of what each pixel has."""
        sides = [
            (1, TILE * count - length + 1)
            for count, length in zip((self.tiles.rows, self.tiles.cols), grid.shape, strict=True)
        ]
        padded = np.pad(grid.astype(np.int64), sides, mode="edge")
        windows: Integers = sliding_window_view(padded, (_SOFT, _SOFT))[::TILE, ::TILE].reshape(-1, _SOFT, _SOFT)
        return windows[chosen]

    def _blur(self, chosen: Integers) -> Value:
        """Blur labels: a window of zeros, then one for every tile, region and width, 0 where pixels have another."""
        g, (widths, level) = self.g, self.map.membership.levels
        found = np.zeros((len(chosen), _SOFT, _SOFT), np.int64)
        if level is not None:
            found = self._cut(level[0].cpu().numpy(), chosen)
        triples: list[tuple[int, int, int]] = []
        self._firsts, self._widths = dict[int, int](), dict[int, int]()
        for number, tile in enumerate(chosen.tolist()):
            used = np.unique(found[number]).tolist()
            self._firsts[tile], self._widths[tile] = 1 + len(triples), len(used)
            triples += [(number, region, width) for region in self.tiles.regions[tile] for width in used]
        axes = g.constant([1, 2])
        window, region, width = (g.piecewise(np.array(column)) for column in zip(*triples, strict=True))
        inside = g("Equal", g("Gather", self._label_windows(chosen), window), g("Unsqueeze", region, axes))
        kernels = g("Gather", self._kernels(np.array(widths)), width)  # [Q, S, side]
        blurred = g("MatMul", kernels, g("Cast", inside, to=FLOAT))
        blurred = g("MatMul", blurred, g("Transpose", kernels, perm=[0, 2, 1]))
        if level is not None:
            self._levels = self._piecewise(found)
            has = g("Equal", g("Gather", self._levels, window), g("Unsqueeze", width, axes))
            blurred = g("Mul", blurred, g("Cast", has, to=FLOAT))
        return g("Concat", np.zeros((1, _SOFT, _SOFT), F32), blurred, axis=0)

    def _kernels(self, widths: NDArray[np.float64]) -> Value:
        """Make the blurs of all widths, (V, S, side)."""
        g = self.g
        distance = np.abs(np.arange(_SOFT)[:, None] - np.arange(_SOFT + 2 * self._reach) + self._reach).astype(F32)
        ends, sigma = np.ceil(4 * widths), np.maximum(widths, 1e-3)
        falloff = g("Div", distance, sigma.astype(F32)[:, None, None])
        kernels = g("Exp", g("Mul", g("Mul", falloff, falloff), F32(-0.5)))
        near = g("LessOrEqual", distance, ends.astype(F32)[:, None, None])
        return g("Mul", kernels, g("Cast", near, to=FLOAT))

    def _label_windows(self, chosen: Integers) -> Value:
        """Cut windows out of the label map, (T, side, side), column by column.

        The map is stored in tiles, one beyond it around: those of one label by that label, the others by their pixels.
        """
        g, rows, cols = self.g, self.tiles.rows, self.tiles.cols
        index = self.map.membership.index[0].cpu().numpy()
        beyond = self.map.num_regions + 1  # nor is it what lists of regions are filled up with
        wide = -(-(self._reach + 1) // TILE)
        frame = [(wide * TILE, (wide + n) * TILE - length) for n, length in zip((rows, cols), index.shape, strict=True)]
        grid = np.pad(index, frame, constant_values=beyond).astype(np.int64)
        down, across = rows + 2 * wide, cols + 2 * wide
        blocks = grid.reshape(down, TILE, across, TILE).transpose(0, 2, 3, 1).reshape(down * across, TILE * TILE)
        mixed = blocks.min(1) != blocks.max(1)
        slots = np.where(mixed, beyond + np.cumsum(mixed), blocks[:, 0])
        flat = g(
            "Expand", g.constant(np.arange(beyond + 1, dtype=np.int32)[:, None]), g.constant([beyond + 1, TILE**2])
        )
        labels = g("Concat", g("Reshape", flat, g.constant([-1])), g.piecewise(blocks[mixed].ravel()), axis=0)
        # rows of a window: how many tiles from the window's, and where in their own; whole tiles along them
        first, side = -1 - self._reach, _SOFT + 2 * self._reach
        tile, pixel = np.divmod(np.arange(first, first + side, dtype=np.int32), TILE)
        corner = g.whole((chosen // cols + wide) * across + chosen % cols + wide)
        steps = np.arange(tile[0], tile[-1] + 1, dtype=np.int32) * np.int32(across)
        number = g("Add", g("Unsqueeze", corner, g.constant([1, 2])), g("Add", tile[:, None], steps))
        place = g("Add", g("Mul", g("Gather", g.whole(slots), number), np.int32(TILE)), pixel[:, None])
        windows = g("Gather", g("Reshape", labels, g.constant([-1, TILE])), place)  # [T, side, tiles, TILE]
        windows = g("Reshape", windows, g.constant([0, side, -1]))
        begin = first % TILE
        return g("Slice", windows, g.constant([begin]), g.constant([begin + side]), g.constant([2]))
