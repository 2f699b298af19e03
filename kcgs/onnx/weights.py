"""Weights of Gaussians for `blocks`, `grids` and `generic`: monomials of the pixel, the exponential, its cutoff."""

from __future__ import annotations

import numpy as np

from .graph import Graph, Value


def monomials(g: Graph, x: Value, y: Value) -> Value:
    """Make 1, x, y, xx, xy, yy at the pixels of a block, column by column, (6, P), from its columns and rows."""
    x, y = g.Unsqueeze(x, [1]), g.Unsqueeze(y, [0])
    sides = g.Concat(g.Shape(x, end=1), g.Shape(y, start=1), axis=0)
    x, y = (g.Reshape(g.Expand(side, sides), [-1]) for side in (x, y))
    rows = (x * 0 + 1, x, y, x * x, x * y, y * y)
    return g.Concat(*[g.Unsqueeze(row, [0]) for row in rows], axis=0)


def weigh(g: Graph, exponent: Value, cutoff: float) -> Value:
    """Make weights of their logarithms, 0 where they are below the cutoff."""
    weight = g.Exp(exponent)
    if cutoff == 0:
        return weight
    # ThresholdedRelu keeps what is greater than alpha; the least weight that counts is the cutoff itself
    return g.ThresholdedRelu(weight, alpha=float(np.nextafter(np.float32(cutoff), np.float32(0))))
