"""Loops that find the blocks of coarse grids, and the four parents from which each block is refined."""

from __future__ import annotations

import numpy as np

from kcgs.compiled.program import Program, inner

from .grid_columns import FIRST_TILE, TILE_COLS, TILE_ROWS

program = Program("coarse grids")


@program.entry
def refine(starts, regions, num_regions, maps, grids):
    """Return starts, regions, parents and parity of `coarse_grids.Blocks` from the starts and regions of level 0."""
    last = grids[len(grids) - 1]
    tile_starts = np.empty(last[FIRST_TILE] + maps * last[TILE_ROWS] * last[TILE_COLS] + 1, np.int64)
    tile_starts[: len(starts)] = starts
    blocks, end = regions, len(regions)
    tiles = np.full(num_regions, -1)  # last tile that was found to hold each region
    for level in range(1, len(grids)):
        fine, coarse = grids[level - 1], grids[level]
        for t in range(maps * coarse[TILE_ROWS] * coarse[TILE_COLS]):
            tile, first = coarse[FIRST_TILE] + t, end
            image, row, col = _place(t, coarse)
            for y in range(max(2 * row - 1, 0), min(2 * row + 2, fine[TILE_ROWS])):
                for x in range(max(2 * col - 1, 0), min(2 * col + 2, fine[TILE_COLS])):
                    child = fine[FIRST_TILE] + (image * fine[TILE_ROWS] + y) * fine[TILE_COLS] + x
                    for block in range(tile_starts[child], tile_starts[child + 1]):
                        region = blocks[block]
                        if tiles[region] == tile:
                            continue
                        tiles[region] = tile
                        if end == len(blocks):
                            blocks = np.append(blocks, np.empty_like(blocks))
                        k = end
                        while k > first and blocks[k - 1] > region:
                            blocks[k] = blocks[k - 1]
                            k -= 1
                        blocks[k] = region
                        end += 1
            tile_starts[tile + 1] = end
    parents, parity = np.full((end, 4), end), np.zeros(end, np.uint8)
    for level in range(len(grids)):
        fine, coarse = grids[level], grids[min(level + 1, len(grids) - 1)]
        for t in range(maps * fine[TILE_ROWS] * fine[TILE_COLS]):
            image, row, col = _place(t, fine)
            tile = fine[FIRST_TILE] + t
            for block in range(tile_starts[tile], tile_starts[tile + 1]):
                parity[block] = 2 * (row % 2) + col % 2
            for k in range(4 if level + 1 < len(grids) else 0):
                y, x = (row + k // 2) // 2, (col + k % 2) // 2
                if y < coarse[TILE_ROWS] and x < coarse[TILE_COLS] and row % 2 >= k // 2 and col % 2 >= k % 2:
                    parent = coarse[FIRST_TILE] + (image * coarse[TILE_ROWS] + y) * coarse[TILE_COLS] + x
                    _find_parents(blocks, tile_starts, tile, parent, parents[:, k])
    return tile_starts, blocks[:end], parents, parity


@inner
def _place(t, grid):
    """Return map, row and column of a tile."""
    return t // (grid[TILE_ROWS] * grid[TILE_COLS]), t // grid[TILE_COLS] % grid[TILE_ROWS], t % grid[TILE_COLS]


@inner
def _find_parents(blocks, tile_starts, tile, parent, parents):
    """Set each block's parent: the block of the same region in the parent tile, which has all regions of the tile."""
    place = tile_starts[parent]
    for block in range(tile_starts[tile], tile_starts[tile + 1]):
        while blocks[place] < blocks[block]:
            place += 1
        parents[block] = place
