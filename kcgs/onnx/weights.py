"""Weights of Gaussians for `blocks`, `grids` and `generic`: monomials of positions, exponential, cutoff."""

from __future__ import annotations

import math

import numpy as np

from .graph import Graph, Value

# factor on whitened coordinates z, so that log w is minus the sum of their squares
ROOT = math.sqrt(0.5)


def monomials(g: Graph, x: Value, y: Value) -> Value:
    """Return 1, x, y, xx, xy, yy of x and y, which are broadcast (up to four dimensions) and flattened: (6, P)."""
    one, first, second = np.eye(3, dtype=np.float32).reshape(3, 3, 1, 1, 1, 1)
    linear = g.Flatten(x * first + y * second + one, axis=1)
    return linear[g.constant([0, 0, 0, 1, 1, 2])] * linear[g.constant([0, 1, 2, 1, 2, 2])]


def weigh(g: Graph, exponent: Value, cutoff: float) -> Value:
    """Return the weights for their logarithms, 0 where they are below the cutoff."""
    weight = g.Exp(exponent)
    if cutoff == 0:
        return weight
    # ThresholdedRelu keeps weights above alpha, and a weight that equals the cutoff must stay
    return g.ThresholdedRelu(weight, alpha=float(np.nextafter(np.float32(cutoff), np.float32(0))))
