"""Loops that give each pixel the value of the nearest pixel with a value: 3 to 9 ms at 480p, in torch 40 to 94 ms."""

from __future__ import annotations

import numpy as np

from kcgs.compiled.program import Program, inner

program = Program("tables of label maps")


@program.entry
def spread(values, nearest):
    """Fill `nearest`, (maps, H, W), with the value of the nearest pixel whose value is not -1; without one it stays.

    Of pixels equally near, the leftmost counts, then the uppermost, as in scipy's distance transform.
    """
    _, height, width = values.shape
    rows, below = np.empty((height, width), np.int64), np.empty(width, np.int64)
    columns, begins = np.empty(width, np.int64), np.empty(width, np.int64)
    for k in range(len(values)):
        _find_rows(values[k], rows, below)
        for y in range(height):
            end = width
            for c in range(_find_columns(rows[y], y, columns, begins) - 1, -1, -1):
                column = columns[c]
                value = values[k, rows[y, column], column]
                for x in range(begins[c], end):
                    nearest[k, y, x] = value
                end = begins[c]


@inner
def _find_rows(values, rows, below):
    """Fill the row of the nearest pixel with a value in each pixel's column; -1: there is none."""
    height, width = values.shape
    below[:] = -1
    for y in range(height):
        for x in range(width):
            below[x] = y if values[y, x] >= 0 else below[x]
            rows[y, x] = below[x]
    below[:] = -1
    for y in range(height - 1, -1, -1):
        for x in range(width):
            above = rows[y, x]
            below[x] = y if values[y, x] >= 0 else below[x]
            if above < 0 or 0 <= below[x] - y < y - above:
                rows[y, x] = below[x]


@inner
def _find_columns(rows, y, columns, begins):
    """List the columns that hold nearest pixels of a row, and where each begins to be nearest; return their number.

    Source: Meijster, Roerdink, Hesselink, "A general algorithm for computing distance transforms in linear time".
    """
    count = 0
    for x in range(len(rows)):
        if rows[x] < 0:
            continue
        begin, square = 0, (rows[x] - y) ** 2 + x**2
        while count > 0:
            other = columns[count - 1]
            begin = (square - (rows[other] - y) ** 2 - other**2) // (2 * (x - other)) + 1  # from here on x is nearer
            if begin > begins[count - 1]:
                break
            begin = 0
            count -= 1
        if begin < len(rows):
            columns[count], begins[count] = x, begin
            count += 1
    return count
