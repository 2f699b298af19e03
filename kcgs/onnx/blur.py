"""Windows of soft contours: the membership of their pixels, blurred out of labels. Made for `membership`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import product

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from kcgs.functional import RegionMap
from kcgs.kernels.membership import RADIUS_SIGMAS, Membership
from kcgs.kernels.resampled import MARGIN
from kcgs.kernels.tiles import TILE

from .graph import FLOAT, Graph, Value
from .groups import Integers
from .packing import pack_integers, pack_runs
from .tiles import WINDOW, Tiles
from .windows import pack_windows, split_tiles, tile_ids


class BlurredWindows:
    """Windows of soft contours, blurred out of the labels around them; tiles by their number of regions.

    A part of a window is what one region has by one width; parts are blurred at once, and summed later.
    """

    def __init__(self, g: Graph, regions: RegionMap, tiles: Tiles, tiles_of: Mapping[int, Integers]) -> None:
        self.graph = g
        self.tiles_of = tiles_of
        ids, (_, level) = tile_ids(tiles_of), regions.tables.membership.levels
        levels = np.zeros((len(ids), WINDOW, WINDOW), np.int64)
        if level is not None:
            levels = cut_windows(tiles, ids, level[0].cpu().numpy())
        parts, self.places = _list_parts(tiles, ids, levels)
        axes = g.constant([1, 2])
        window, region, width = (pack_runs(g, column) for column in parts)
        inside = g.Equal(_label_windows(g, regions, tiles, ids)[window], g.Unsqueeze(region, axes))
        kernels = _kernels(g, regions.tables.membership)[width]  # [parts, S, side]
        blurred = kernels @ inside.astype(FLOAT) @ g.Transpose(kernels, perm=[0, 2, 1])
        self.levels = None if level is None else pack_windows(g, levels)  # (T, S, S), place among the map's widths
        if self.levels is not None:
            blurred = blurred * g.Equal(self.levels[window], g.Unsqueeze(width, axes)).astype(FLOAT)
        self.parts = g.Concat(np.zeros((1, WINDOW, WINDOW), np.float32), blurred, axis=0)

    def unfold(self, count: int) -> Value:
        """Sum the parts of windows over their widths, and normalise: (T, K, S, S)."""
        g, places = self.graph, [self.places[tile] for tile in self.tiles_of[count].tolist()]
        num_widths = max(place.shape[1] for place in places)
        ids = np.zeros((len(places), count, num_widths), np.int64)
        for row, place in zip(ids, places, strict=True):
            row[: place.shape[0], : place.shape[1]] = place
        windows = self.parts[pack_integers(g, ids if num_widths > 1 else ids[:, :, 0])]
        windows = g.ReduceSum(windows, [2], keepdims=0) if num_widths > 1 else windows
        # outside the map there is no label, and no membership
        return windows / g.Max(g.ReduceSum(windows, [1], keepdims=1), 1e-30)


def crisp_windows(
    g: Graph, regions: RegionMap, tiles: Tiles, tiles_of: Mapping[int, Integers]
) -> Callable[[int], Value]:
    """Make blurred windows whose pixels are given to their own label, as :class:`kcgs.kernels.Crisp` has it."""
    blurred = BlurredWindows(g, regions, tiles, tiles_of)
    index = cut_windows(tiles, tile_ids(tiles_of), regions.tables.membership.index[0].cpu().numpy())
    labels = split_tiles(g, tiles_of, pack_windows(g, index))

    def unfold(count: int) -> Value:
        numbers, windows = tiles_of[count], blurred.unfold(count)
        best = g.ReduceMax(windows, [1], keepdims=1)
        ids = np.full((len(numbers), count, 1, 1), -1, np.int32)
        for row, tile in zip(ids[..., 0, 0], numbers.tolist(), strict=True):
            row[: len(tiles.regions[tile])] = tiles.regions[tile]
        loses = g.And(g.Equal(g.Unsqueeze(labels[count], [1]), ids), g.Less(windows, best))
        return g.Where(loses, best + MARGIN, windows)

    return unfold


def cut_windows(tiles: Tiles, ids: Integers, grid: Integers) -> Integers:
    """Cut the windows of tiles, (T, S, S), out of what each pixel has, (H, W)."""
    sides = [(1, TILE * count - length + 1) for count, length in zip((tiles.rows, tiles.cols), grid.shape, strict=True)]
    padded = np.pad(grid.astype(np.int64), sides, mode="edge")
    windows: Integers = sliding_window_view(padded, (WINDOW, WINDOW))[::TILE, ::TILE].reshape(-1, WINDOW, WINDOW)
    return windows[ids]


def _list_parts(tiles: Tiles, ids: Integers, levels: Integers) -> tuple[Integers, dict[int, Integers]]:
    """List the window, region and width of each part, (3, parts), and the places of each tile's, [regions, widths].

    Place 0 is that of zeros.
    """
    triples: list[tuple[int, int, int]] = []
    places: dict[int, Integers] = {}
    for number, tile in enumerate(ids.tolist()):
        pairs = list(product(tiles.regions[tile], np.unique(levels[number]).tolist()))
        places[tile] = 1 + len(triples) + np.arange(len(pairs)).reshape(len(tiles.regions[tile]), -1)
        triples += [(number, *pair) for pair in pairs]
    return np.array(triples).T, places


def _kernels(g: Graph, membership: Membership) -> Value:
    """Make the blurs of V widths from the pixels of a label window to those of a window, (V, S, side).

    The taps are those of `kcgs.kernels.membership`, by operators, since a file that stored them would be larger.
    """
    widths, radius = np.array(membership.levels.widths), membership.radius
    distance = np.abs(np.arange(WINDOW)[:, None] - np.arange(WINDOW + 2 * radius) + radius).astype(np.float32)
    ends, sigma = np.ceil(RADIUS_SIGMAS * widths), np.maximum(widths, 1e-3)
    falloff = g.Div(distance, sigma.astype(np.float32)[:, None, None])
    kernels = g.Exp(falloff * falloff * -0.5)
    return kernels * g.LessOrEqual(distance, ends.astype(np.float32)[:, None, None]).astype(FLOAT)


def _label_windows(g: Graph, regions: RegionMap, tiles: Tiles, ids: Integers) -> Value:
    """Cut windows out of the label map with all that their blur reads, (T, side, side), column by column.

    The map is stored in tiles, with some around it: those of one label by that label, the others by their pixels.
    """
    rows, cols, radius = tiles.rows, tiles.cols, regions.tables.membership.radius
    index = regions.tables.membership.index[0].cpu().numpy()
    outside = regions.num_regions + 1  # a label that no region has, nor what lists of regions are filled up with
    rim = -(-(radius + 1) // TILE)  # tiles around the map
    frame = [(rim * TILE, (rim + n) * TILE - length) for n, length in zip((rows, cols), index.shape, strict=True)]
    grid = np.pad(index, frame, constant_values=outside).astype(np.int64)
    down, across = rows + 2 * rim, cols + 2 * rim
    blocks = grid.reshape(down, TILE, across, TILE).transpose(0, 2, 3, 1).reshape(down * across, TILE * TILE)
    mixed = blocks.min(1) != blocks.max(1)
    slots = np.where(mixed, outside + np.cumsum(mixed), blocks[:, 0])
    flat = g.Expand(np.arange(outside + 1, dtype=np.int32)[:, None], [outside + 1, TILE**2])
    labels = g.Concat(g.Reshape(flat, [-1]), pack_runs(g, blocks[mixed].ravel()), axis=0)
    # rows of a window: how many tiles from the window's, and where in their own; whole tiles along them
    first, side = -1 - radius, WINDOW + 2 * radius
    tile, pixel = np.divmod(np.arange(first, first + side, dtype=np.int32), TILE)
    corner = pack_integers(g, (ids // cols + rim) * across + ids % cols + rim)
    steps = np.arange(tile[0], tile[-1] + 1, dtype=np.int32) * np.int32(across)
    number = g.Unsqueeze(corner, [1, 2]) + (g.constant(tile[:, None]) + steps)
    place = pack_integers(g, slots)[number] * TILE + pixel[:, None]
    windows = g.Reshape(labels, [-1, TILE])[place]  # [T, side, tiles, TILE]
    windows = g.Reshape(windows, [0, side, -1])
    begin = first % TILE
    return g.Slice(windows, [begin], [begin + side], [2])
