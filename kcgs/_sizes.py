"""Sizes, which a graph may leave open."""

from __future__ import annotations

import torch


def is_equal(size: int, other: int) -> bool:
    """Compare two sides; in a graph, True only if they are always equal, since a comparison would become a guard."""
    if not torch.compiler.is_compiling() and isinstance(size, int) and isinstance(other, int):
        return size == other
    from torch.fx.experimental.symbolic_shapes import statically_known_true

    return statically_known_true(size == other)
