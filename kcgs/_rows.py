"""Slices of an image's rows, so that temporary copies take little memory."""

from __future__ import annotations

from collections.abc import Iterator

_PIXELS = 1 << 14  # per slice: it fits into a cache, and torch starts no threads, which would cost more than they save


def row_slices(height: int, width: int, pixels: int = _PIXELS) -> Iterator[slice]:
    """Divide the rows of an image into slices of few pixels, at least one row each."""
    step = max(1, pixels // max(1, width))
    for top in range(0, height, step):
        yield slice(top, min(top + step, height))
