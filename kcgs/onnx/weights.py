"""Weights of Gaussians for `blocks`, `grids` and `generic`: monomials of places, the exponential, its cutoff."""

from __future__ import annotations

import math

import numpy as np

from .graph import Graph, Value

# scales whitened coordinates z: log w is then minus the sum of their squares
ROOT = math.sqrt(0.5)


def monomials(g: Graph, x: Value, y: Value) -> Value:
    """Make 1, x, y, xx, xy, yy of numbers of up to four dimensions, which are broadcast: (6, all of them)."""
    one, first, second = np.eye(3, dtype=np.float32).reshape(3, 3, 1, 1, 1, 1)
    linear = g.Flatten(x * first + y * second + one, axis=1)
    return linear[g.constant([0, 0, 0, 1, 1, 2])] * linear[g.constant([0, 1, 2, 1, 2, 2])]


def weigh(g: Graph, exponent: Value, cutoff: float) -> Value:
    """Make weights of their logarithms, 0 where they are below the cutoff."""
    weight = g.Exp(exponent)
    if cutoff == 0:
        return weight
    # ThresholdedRelu keeps what is greater than alpha; the least weight that counts is the cutoff itself
    return g.ThresholdedRelu(weight, alpha=float(np.nextafter(np.float32(cutoff), np.float32(0))))
