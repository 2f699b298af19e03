"""The Gaussians of every tile of 16 x 16 pixels, found in three launches.

`_prepare` makes a box of tiles for each Gaussian, and reserves a slot for each tile of it. `_bin` lists the Gaussians
of each cell of 8 x 8 tiles. `_tile` lists the Gaussians of each tile, as pairs, and writes into every slot the place of
its pair. Every list is in the order of the Gaussians.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

from kcgs.errors import InvalidArgument
from kcgs.maps import TILE, table_at

from ..interface import SplatInputs
from ..tiles import MARGIN, RELATIVE_MARGIN, TileGrid, grid_of
from ..whitened import LEAST_SCALE, MEAN_LIMIT, SCALE_LIMITS, Z_LIMIT, support_radius
from ..whitened import SCALE as EXPONENT_SCALE
from .capacity import notes_of, remember, report, reports, reserve, room_for
from .triton_function import triton_function

# Gaussians per program of `_prepare`
_PREPARE_BLOCK = 128
# Gaussians that a loop of `_bin` or `_tile` compares at once
_BIN_BLOCK = 1024
_TILE_BLOCK = 128

# tiles along a side of an image: their numbers have 16 bits, of which one is the sign
_MOST_TILES = (1 << 15) - 1

# constants of the programs
SIDE = tl.constexpr(TILE)
PIECE = tl.constexpr(8)  # pairs of a program of the backward
SCALE = tl.constexpr(EXPONENT_SCALE)
_CELL = tl.constexpr(8)  # tiles along a side of a cell
_REACH = tl.constexpr(1 + RELATIVE_MARGIN)
_MARGIN = tl.constexpr(MARGIN)
_Z_LIMIT = tl.constexpr(Z_LIMIT)
_MEAN_LIMIT = tl.constexpr(MEAN_LIMIT)
_LEAST_SCALE = tl.constexpr(LEAST_SCALE)
_MOST_SCALE = tl.constexpr(SCALE_LIMITS[1])

# places in CudaPlan.counters, int64
SLOTS = tl.constexpr(0)  # tiles of all boxes
INVALID = tl.constexpr(1)  # Gaussians whose values are not finite or out of range, or whose region id is negative
_UNKNOWN_IDS = tl.constexpr(2)  # Gaussians whose region id the map does not hold
_ENTRIES = tl.constexpr(3)  # entries of the cells' lists
_PAIRS = tl.constexpr(4)  # places of the tiles' lists
PIECES = tl.constexpr(5)
_NOTES = tl.constexpr(6)  # the counters of earlier plans, see capacity.py
_COUNTERS = 9


class CudaPlan(NamedTuple):
    """The lists of a batch of images; Gaussians are numbered across the batch."""

    counters: Tensor  # [9] int64
    gaussians: Tensor  # [4, B * N] int32: first and last tile of the box, each row * 2^16 + column; first slot; region
    lists: Tensor  # [2, cells + tiles] int32: place of the first entry or pair, and their number
    slots: Tensor  # [4, S] int32: entries of cells; Gaussians of pairs, and their planes; pairs of slots, -1: none
    coefficients: Tensor  # [S, 5] float32, of pairs: see tiles.coefficients, times SCALE
    pieces: Tensor  # [2, P] int32: a tile, and the first of up to 8 of its pairs
    weights: Tensor | None  # of the map's tiles
    grid: TileGrid
    num_cells: int
    num_unknown_ids: int  # Gaussians whose region id the map does not hold, where the plan waited for the device

    @property
    def room(self) -> int:
        """Slots that there is room for."""
        return self.coefficients.shape[0]


def plan(inputs: SplatInputs) -> CudaPlan | None:
    """List the pairs; None where a value is not finite or out of range, or a region id is negative."""
    means, cholesky, colors = (t.contiguous() for t in inputs.gaussians)
    count, channels = colors.shape[-2:]
    grid, (height, width), device = grid_of(inputs), inputs.size, means.device
    cell_rows, cell_cols = -(-grid.rows // _CELL.value), -(-grid.cols // _CELL.value)
    if max(grid.rows, grid.cols) > _MOST_TILES:
        raise InvalidArgument("size", f"at most {_MOST_TILES * TILE} on backend 'cuda'", inputs.size)
    num_cells, total = grid.batch * cell_rows * cell_cols, grid.batch * count
    radius, notes, num_unknown_ids = support_radius(inputs.cutoff, means.dtype), notes_of(device), 0
    room = reserve(inputs)
    waits = room is None
    counters = torch.zeros(_COUNTERS, dtype=torch.int64, device=device)
    gaussians = torch.empty(4, total, dtype=torch.int32, device=device)
    ids, num_ids, map_tiles, starts, regions, planes, weights = None, 0, 1, None, None, None, None
    if inputs.table is not None:
        starts, regions, planes, weights = table_at(inputs.table, inputs.size).tiles
        ids, num_ids, map_tiles = inputs.table.ids, inputs.table.num_regions, len(starts) - 1
    with torch.cuda.device_of(means):
        _prepare(
            (-(-total // _PREPARE_BLOCK),),
            means, cholesky, colors, inputs.region_ids, ids, counters, gaussians, notes, total, num_ids,
            num_ids.bit_length(), height, width, channels, radius, MAPPED=num_ids > 0,
            NOTES=waits and reports(), BLOCK=_PREPARE_BLOCK,
        )  # fmt: skip
        if room is None:
            room, invalid, num_unknown_ids, _, _, _, *noted = counters.tolist()
            report(*noted)
            if invalid:
                return None
            remember(inputs, room)
        lists = torch.empty(2, num_cells + grid.total, dtype=torch.int32, device=device)
        with room_for(inputs, room):
            slots = torch.empty(4, room, dtype=torch.int32, device=device)
            coefficients = torch.empty(room, 5, dtype=torch.float32, device=device)
            pieces = torch.empty(2, room // PIECE.value + grid.total, dtype=torch.int32, device=device)
        _bin(
            (num_cells,),
            gaussians, counters, lists, slots, notes, total, count, room, num_cells + grid.total, cell_rows, cell_cols,
            NOTES=not waits, BLOCK=_BIN_BLOCK,
        )  # fmt: skip
        _tile(
            (grid.total,),
            means, cholesky, counters, gaussians, lists, slots, coefficients, pieces, starts, regions, planes,
            map_tiles, total, room, num_cells, grid.total, grid.rows, grid.cols, cell_rows, cell_cols, pieces.shape[1],
            radius, MAPPED=num_ids > 0, BLOCK=_TILE_BLOCK,
        )  # fmt: skip
    return CudaPlan(counters, gaussians, lists, slots, coefficients, pieces, weights, grid, num_cells, num_unknown_ids)


@triton_function(warps=4)
def _prepare(
    means, cholesky, colors, region_ids, ids, counters, gaussians, notes,
    total, num_ids, steps, height, width, channels, radius,
    MAPPED: tl.constexpr, NOTES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Check a Gaussian, find its region, the box of tiles that its support touches, and its first slot."""
    if NOTES and tl.program_id(0) == 0:
        tl.store(counters + _NOTES, tl.atomic_xchg(notes, 0))
        tl.store(counters + _NOTES + 1, tl.atomic_xchg(notes + 1, 0))
        tl.store(counters + _NOTES + 2, tl.atomic_xchg(notes + 2, 0))
    g = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    present = g < total
    x = tl.load(means + 2 * g, mask=present, other=0.0).to(tl.float64)
    y = tl.load(means + 2 * g + 1, mask=present, other=0.0).to(tl.float64)
    l11 = tl.load(cholesky + 3 * g, mask=present, other=1.0).to(tl.float64)
    l21 = tl.load(cholesky + 3 * g + 1, mask=present, other=0.0).to(tl.float64)
    l22 = tl.load(cholesky + 3 * g + 2, mask=present, other=1.0).to(tl.float64)
    # comparisons with NaN fail
    valid = (tl.abs(x) <= _MEAN_LIMIT) & (tl.abs(y) <= _MEAN_LIMIT) & (tl.abs(l21) <= _MOST_SCALE)
    valid &= (l11 >= _LEAST_SCALE) & (l11 <= _MOST_SCALE) & (l22 >= _LEAST_SCALE) & (l22 <= _MOST_SCALE)
    for c in range(channels):
        color = tl.load(colors + g.to(tl.int64) * channels + c, mask=present, other=0.0)
        valid &= tl.abs(color) < float("inf")
    known = present
    if MAPPED:
        region_id = tl.load(region_ids + g, mask=present, other=0)
        valid &= region_id >= 0
        region = tl.zeros([BLOCK], tl.int32)  # the number of smaller ids, bit by bit
        for k in range(steps):
            after = region + (1 << (steps - 1 - k))
            smaller = tl.load(ids + after - 1, mask=after <= num_ids, other=1 << 62) < region_id
            region = tl.where(smaller, after, region)
        known &= tl.load(ids + region, mask=region < num_ids, other=-1) == region_id
        tl.store(gaussians + 3 * total + g, region, mask=present)
        num_unknown_ids = tl.sum((present & ~known).to(tl.int32), axis=0)
        tl.atomic_add(counters + _UNKNOWN_IDS, num_unknown_ids.to(tl.int64), mask=num_unknown_ids > 0)
    invalid = tl.sum((present & ~valid).to(tl.int32), axis=0)
    tl.atomic_add(counters + INVALID, invalid.to(tl.int64), mask=invalid > 0)

    across = l11 * radius * _REACH + _MARGIN
    down = tl.sqrt(l21 * l21 + l22 * l22) * radius * _REACH + _MARGIN
    left, right = tl.ceil(x - across - 0.5), tl.floor(x + across - 0.5)
    top, bottom = tl.ceil(y - down - 0.5), tl.floor(y + down - 0.5)
    touches = present & known & valid & (left <= right) & (right >= 0) & (left < width)
    touches &= (top <= bottom) & (bottom >= 0) & (top < height)
    x0, x1 = _tile_of(left, touches, width), _tile_of(right, touches, width)
    y0, y1 = _tile_of(top, touches, height), _tile_of(bottom, touches, height)
    room = tl.where(touches, (x1 - x0 + 1) * (y1 - y0 + 1), 0).to(tl.int64)
    first = tl.atomic_add(counters + SLOTS, tl.sum(room, axis=0)) + tl.cumsum(room, axis=0) - room
    # a box that ends before it begins holds no tile
    tl.store(gaussians + g, tl.where(touches, (y0 << 16) + x0, 1 << 16), mask=present)
    tl.store(gaussians + total + g, tl.where(touches, (y1 << 16) + x1, 0), mask=present)
    tl.store(gaussians + 2 * total + g, first.to(tl.int32), mask=present)


@triton.jit
def _tile_of(pixel, touches, length):
    inside = tl.minimum(tl.maximum(tl.where(touches, pixel, 0.0), 0.0), (length - 1).to(tl.float64))
    return inside.to(tl.int32) // SIDE


@triton.jit
def fails(counters, room):
    """Return whether lists do not fit, or values are not valid: nothing is listed then, and the image is NaN."""
    return (tl.load(counters + SLOTS) > room) | (tl.load(counters + INVALID) > 0)


@triton.jit
def _box(gaussians, g, total, mask):
    first = tl.load(gaussians + g, mask=mask, other=1 << 16)
    last = tl.load(gaussians + total + g, mask=mask, other=0)
    return first & 0xFFFF, first >> 16, last & 0xFFFF, last >> 16


@triton_function(warps=8)
def _bin(
    gaussians, counters, lists, slots, notes, total, count, room, num_lists, cell_rows, cell_cols,
    NOTES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """List the Gaussians whose boxes touch a cell."""
    cell = tl.program_id(0)
    image = cell // (cell_rows * cell_cols)
    left = cell % cell_cols * _CELL
    top = cell // cell_cols % cell_rows * _CELL
    failed = fails(counters, room)
    if NOTES and cell == 0:
        needed = tl.load(counters + SLOTS)
        tl.atomic_add(notes, (needed > room).to(tl.int64))
        tl.atomic_add(notes + 1, (tl.load(counters + INVALID) > 0).to(tl.int64))
        tl.atomic_max(notes + 2, needed)
    begin = image * count
    end = tl.where(failed, begin, begin + count)
    hits = tl.zeros([BLOCK], tl.int32)
    for k in range(begin, end, BLOCK):
        g = k + tl.arange(0, BLOCK)
        x0, y0, x1, y1 = _box(gaussians, g, total, g < end)
        hits += _overlaps(x0, y0, x1, y1, left, top).to(tl.int32)
    length = tl.sum(hits, axis=0)
    place = tl.atomic_add(counters + _ENTRIES, length.to(tl.int64)).to(tl.int32)
    tl.store(lists + cell, place)
    tl.store(lists + num_lists + cell, length)
    for k in range(begin, end, BLOCK):
        g = k + tl.arange(0, BLOCK)
        x0, y0, x1, y1 = _box(gaussians, g, total, g < end)
        hit = _overlaps(x0, y0, x1, y1, left, top)
        rank = tl.cumsum(hit.to(tl.int32), axis=0)
        tl.store(slots + place + rank - 1, g, mask=hit)
        place += tl.sum(hit.to(tl.int32), axis=0)


@triton.jit
def _overlaps(x0, y0, x1, y1, left, top):
    touches = (x0 < left + _CELL) & (x1 >= left) & (y0 < top + _CELL) & (y1 >= top)
    return touches & (y0 <= y1)


@triton_function(warps=4)
def _tile(
    means, cholesky, counters, gaussians, lists, slots, coefficients, pieces, starts, regions, planes,
    map_tiles, total, room, num_cells, num_tiles, rows, cols, cell_rows, cell_cols, num_pieces, radius,
    MAPPED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """List the pairs of a tile, cut into pieces."""
    room = room.to(tl.int64)
    tile = tl.program_id(0)
    column, row, image = tile % cols, tile // cols % rows, tile // (rows * cols)
    cell = (image * cell_rows + row // _CELL) * cell_cols + column // _CELL
    num_lists = num_cells + num_tiles
    begin = tl.load(lists + cell)
    end = begin + tl.load(lists + num_lists + cell)
    hits = tl.zeros([BLOCK], tl.int32)
    for k in range(begin, end, BLOCK):
        entry = k + tl.arange(0, BLOCK)
        g = tl.load(slots + entry, mask=entry < end, other=0)
        x0, y0, x1, y1 = _box(gaussians, g, total, entry < end)
        hits += ((x0 <= column) & (x1 >= column) & (y0 <= row) & (y1 >= row)).to(tl.int32)
    # reserve a place for every box that holds the tile: Gaussians that do not reach the tile leave a gap at the end
    first = tl.atomic_add(counters + _PAIRS, tl.sum(hits, axis=0).to(tl.int64)).to(tl.int32)
    place = first
    if MAPPED:
        map_tile = tile % map_tiles
        first_region, last_region = tl.load(starts + map_tile), tl.load(starts + map_tile + 1)
    for k in range(begin, end, BLOCK):
        entry = k + tl.arange(0, BLOCK)
        g = tl.load(slots + entry, mask=entry < end, other=0)
        x0, y0, x1, y1 = _box(gaussians, g, total, entry < end)
        holds = (x0 <= column) & (x1 >= column) & (y0 <= row) & (y1 >= row)
        keeps = holds
        if MAPPED:
            region = tl.load(gaussians + 3 * total + g, mask=holds, other=-1)
            plane = tl.full([BLOCK], -2, tl.int32)
            for r in range(first_region, last_region):
                plane = tl.where(region == tl.load(regions + r), tl.load(planes + r), plane)
            keeps &= plane >= -1
        x = tl.load(means + 2 * g, mask=keeps, other=0.0).to(tl.float64)
        y = tl.load(means + 2 * g + 1, mask=keeps, other=0.0).to(tl.float64)
        l11 = tl.load(cholesky + 3 * g, mask=keeps, other=1.0).to(tl.float64)
        l21 = tl.load(cholesky + 3 * g + 1, mask=keeps, other=0.0).to(tl.float64)
        l22 = tl.load(cholesky + 3 * g + 2, mask=keeps, other=1.0).to(tl.float64)
        # offset of the tile's centre from the mean; the box bounds z1, and `nearest` is the least |z2| times l22
        x = column * SIDE + SIDE / 2 - x
        y = row * SIDE + SIDE / 2 - y
        inverse1, inverse2 = 1 / l11, 1 / l22
        slope = l21 * inverse1
        nearest = tl.abs(y - slope * x) - (SIDE - 1) / 2 * (1 + tl.abs(slope))
        keeps &= nearest <= radius * _REACH * l22 + _MARGIN
        rank = tl.cumsum(keeps.to(tl.int32), axis=0)
        pair = place + rank - 1
        tl.store(slots + room + pair, g, mask=keeps)
        if MAPPED:
            tl.store(slots + 2 * room + pair, plane, mask=keeps)
        address = coefficients + pair.to(tl.int64) * 5
        _store(address, x * inverse1, keeps)
        _store(address + 1, inverse1, keeps)
        _store(address + 2, (y - slope * x) * inverse2, keeps)
        _store(address + 3, -slope * inverse2, keeps)
        _store(address + 4, inverse2, keeps)
        slot = tl.load(gaussians + 2 * total + g, mask=holds, other=0) + (row - y0) * (x1 - x0 + 1) + column - x0
        tl.store(slots + 3 * room + slot, tl.where(keeps, pair, -1), mask=holds)
        place += tl.sum(keeps.to(tl.int32), axis=0)
    tl.store(lists + num_cells + tile, first)
    tl.store(lists + num_lists + num_cells + tile, place - first)
    count = tl.cdiv(place - first, PIECE)
    piece = tl.atomic_add(counters + PIECES, count.to(tl.int64)).to(tl.int32)
    for k in range(0, count, BLOCK):
        number = k + tl.arange(0, BLOCK)
        tl.store(pieces + piece + number, tile, mask=number < count)
        tl.store(pieces + num_pieces + piece + number, first + number * PIECE, mask=number < count)


@triton.jit
def _store(address, coefficient, mask):
    scaled = tl.minimum(tl.maximum(coefficient, -_Z_LIMIT), _Z_LIMIT) * SCALE
    tl.store(address, scaled.to(tl.float32), mask=mask)
