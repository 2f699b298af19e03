"""Windows of memberships, computed by blurring labels; for `membership`."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product

import numpy as np
import torch
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from kcgs.maps import TILE, Membership, SmoothMembership, truncated_gaussian

from .graph import FLOAT, Graph, Value
from .groups import Integers
from .packing import pack_integers, pack_runs
from .tiles import WINDOW, Tiles
from .windows import pack_windows, tile_ids


class BlurredWindows:
    """Windows of memberships, computed by blurring labels; `tiles_of` has the tiles by their number of regions.

    A part of a window is the membership of one region with one contour width; all parts are blurred at once, and summed
    later.
    """

    def __init__(self, g: Graph, membership: Membership, tiles: Tiles, tiles_of: Mapping[int, Integers]) -> None:
        self.graph = g
        self.tiles_of = tiles_of
        ids, index = tile_ids(tiles_of), membership.table.width_index
        width_index = np.zeros((len(ids), WINDOW, WINDOW), np.int64)
        if index is not None:
            width_index = cut_windows(tiles, ids, index[0].cpu().numpy())
        parts, self.places = _list_parts(tiles, ids, width_index)
        axes = g.constant([1, 2])
        window, region, width = (pack_runs(g, column) for column in parts)
        region = g.Unsqueeze(region, axes)
        kernels = _kernels(g, membership)[width]  # [parts, S, side]

        def blur(pixels: Value) -> Value:
            return kernels @ pixels.astype(FLOAT) @ g.Transpose(kernels, perm=[0, 2, 1])

        table, kinds = _list_kinds(membership)
        pixels = _pixel_windows(g, tiles, ids, kinds, membership.radius, len(table) - 1)[window]
        label, weight, other, other_weight = (column[:, 0] for column in np.split(table, 4, axis=1))
        inside = g.Equal(g.constant(label.astype(np.int32))[pixels], region).astype(FLOAT)
        if isinstance(membership, SmoothMembership):
            taken = g.Equal(g.constant(other.astype(np.int32))[pixels], region).astype(FLOAT)
            weight, other_weight = weight.astype(np.float32), other_weight.astype(np.float32)
            inside = inside * g.constant(weight)[pixels] + taken * g.constant(other_weight)[pixels]
        # pixels outside the map have no label and no membership
        blurred = blur(inside) / g.Max(blur(g.Less(pixels, np.int32(len(table) - 1))), 1e-30)
        if index is not None:
            is_own = g.Equal(pack_windows(g, width_index)[window], g.Unsqueeze(width, axes))
            blurred = blurred * is_own.astype(FLOAT)
        self.parts = g.Concat(np.zeros((1, WINDOW, WINDOW), np.float32), blurred, axis=0)

    def unfold(self, count: int) -> Value:
        """Sum the parts of windows over their widths: (T, K, S, S)."""
        g, places = self.graph, [self.places[tile] for tile in self.tiles_of[count].tolist()]
        num_widths = max(place.shape[1] for place in places)
        ids = np.zeros((len(places), count, num_widths), np.int64)
        for row, place in zip(ids, places, strict=True):
            row[: place.shape[0], : place.shape[1]] = place
        windows = self.parts[pack_integers(g, ids if num_widths > 1 else ids[:, :, 0])]
        return g.ReduceSum(windows, [2], keepdims=0) if num_widths > 1 else windows


def _list_kinds(membership: Membership) -> tuple[NDArray[np.float64], Integers]:
    """List the kinds of pixels, (kinds, 4): label, weight, other label, its weight; and each pixel's kind, (H, W).

    The last kind is for pixels outside the map.
    """
    index, none = membership.index, torch.zeros_like(membership.index)
    smooth = membership.smooth_labels if isinstance(membership, SmoothMembership) else (none, none, none)
    rows = torch.stack([part[0].double().flatten() for part in (index, *smooth)], 1).cpu().numpy()
    table, kinds = np.unique(rows, axis=0, return_inverse=True)
    # neither a region nor the padding of lists of regions has this label
    outside = [[membership.table.num_regions + 1, 0, 0, 0]]
    return np.concatenate([table, outside]), kinds.reshape(index.shape[1:])


def cut_windows(tiles: Tiles, ids: Integers, grid: Integers) -> Integers:
    """Cut the windows of tiles, (T, S, S), out of a grid of pixels, (H, W)."""
    sides = [(1, TILE * count - length + 1) for count, length in zip((tiles.rows, tiles.cols), grid.shape, strict=True)]
    padded = np.pad(grid.astype(np.int64), sides, mode="edge")
    windows: Integers = sliding_window_view(padded, (WINDOW, WINDOW))[::TILE, ::TILE].reshape(-1, WINDOW, WINDOW)
    return windows[ids]


def _list_parts(tiles: Tiles, ids: Integers, width_index: Integers) -> tuple[Integers, dict[int, Integers]]:
    """List window, region and width of each part, (3, parts), and the places of each tile's parts, [regions, widths].

    Place 0 is a part of zeros.
    """
    triples: list[tuple[int, int, int]] = []
    places: dict[int, Integers] = {}
    for number, tile in enumerate(ids.tolist()):
        pairs = list(product(tiles.regions[tile], np.unique(width_index[number]).tolist()))
        places[tile] = 1 + len(triples) + np.arange(len(pairs)).reshape(len(tiles.regions[tile]), -1)
        triples += [(number, *pair) for pair in pairs]
    return np.array(triples).T, places


def _kernels(g: Graph, membership: Membership) -> Value:
    """Return the blurs of V widths as matrices from the pixels of a label window to those of a window, (V, S, side)."""
    radius = membership.radius
    # the tap of the last distance is 0; it also stands for all larger distances
    steps = torch.arange(radius + 2, dtype=torch.float64)
    taps = truncated_gaussian(steps, torch.tensor(membership.widths, dtype=torch.float64)[:, None]).float().numpy()
    distance = np.abs(np.arange(WINDOW)[:, None] - np.arange(WINDOW + 2 * radius) + radius)
    return g.Gather(taps, pack_integers(g, distance.clip(max=radius + 1)), axis=1)


def _pixel_windows(g: Graph, tiles: Tiles, ids: Integers, pixels: Integers, radius: int, outside: int) -> Value:
    """Cut windows out of integers (H, W) with all pixels that their blur reads, (T, side, side), by columns.

    The integers are stored in tiles, with a rim of `outside`: uniform tiles as one number, other tiles by their pixels.
    """
    rows, cols = tiles.rows, tiles.cols
    rim = -(-(radius + 1) // TILE)  # tiles around the map
    frame = [(rim * TILE, (rim + n) * TILE - length) for n, length in zip((rows, cols), pixels.shape, strict=True)]
    grid = np.pad(pixels, frame, constant_values=outside)
    down, across = rows + 2 * rim, cols + 2 * rim
    blocks = grid.reshape(down, TILE, across, TILE).transpose(0, 2, 3, 1).reshape(down * across, TILE * TILE)
    mixed = blocks.min(1) != blocks.max(1)
    values, flat = np.unique(blocks[~mixed, 0], return_inverse=True)
    slots = np.zeros(len(blocks), np.int64)
    slots[~mixed], slots[mixed] = flat, len(values) + np.arange(mixed.sum())
    plain = g.Expand(g.Unsqueeze(pack_integers(g, values), [1]), [len(values), TILE**2])
    numbers = g.Concat(g.Reshape(plain, [-1]), pack_runs(g, blocks[mixed].ravel()), axis=0)
    # rows of a window: offset of their tile, and their place in this tile; along the rows, whole tiles are read
    first, side = -1 - radius, WINDOW + 2 * radius
    tile, pixel = np.divmod(np.arange(first, first + side, dtype=np.int32), TILE)
    corner = pack_integers(g, (ids // cols + rim) * across + ids % cols + rim)
    steps = np.arange(tile[0], tile[-1] + 1, dtype=np.int32) * np.int32(across)
    number = g.Unsqueeze(corner, [1, 2]) + (g.constant(tile[:, None]) + steps)
    place = pack_integers(g, slots)[number] * TILE + pixel[:, None]
    windows = g.Reshape(numbers, [-1, TILE])[place]  # [T, side, tiles, TILE]
    windows = g.Reshape(windows, [0, side, -1])
    begin = first % TILE
    return g.Slice(windows, [begin], [begin + side], [2])
