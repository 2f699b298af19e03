"""The columns of an array of grids, in the order of `coarse_grids.Grid`.

They have a module of their own, since loops are compiled anew when the text of a module that they import changes.
"""

NODE_ROWS = 0
NODE_COLS = 1
TILE_ROWS = 2
TILE_COLS = 3
FIRST_TILE = 4  # number of the first tile of a level; tiles are numbered through all levels
