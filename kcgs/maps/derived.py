"""Results that are derived from a map's table on first use: the map at other sizes, and a kernel's arrays.

A RegionMap cannot hold them: operators of torch take no objects, so that a table reaches the kernels as tensors, also
from compiled graphs. They are kept by `starts`, a tensor that no other table has, and live as long as it does; so they
must not refer to it. As an attribute of this tensor they would be pickled with it, for instance in an exported program.
Results of labels alone, whose table has no `starts`, are not kept.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TypeVar

from torch.utils.weak import WeakTensorKeyDictionary

from .membership import Membership
from .resampled import Resampled, SmoothMembership
from .table import MapTable, with_positions
from .tiles import with_tiles

T = TypeVar("T")

_KEPT_SIZES = 3  # per map: a viewer renders at ever new sizes

# results by the `starts` of a table, then by the function
_derived: WeakTensorKeyDictionary = WeakTensorKeyDictionary()


def cached_for(table: MapTable, make: Callable[[MapTable], T]) -> T:
    """Return make(table); the function is called once per table that has `starts`."""
    if table.starts is None:
        return make(table)
    results: dict[Callable[[MapTable], T], T] = _derived.setdefault(table.starts, {})
    if make not in results:
        results[make] = make(table)
    return results[make]


def _resampler(table: MapTable) -> Callable[[tuple[int, int]], Resampled]:
    """Return a function that makes the membership of a map at another size, and keeps a few."""
    smooth = SmoothMembership(Membership(table.without_tiles()))
    return functools.lru_cache(_KEPT_SIZES)(functools.partial(Resampled, smooth))


def membership_at(table: MapTable, size: tuple[int, int]) -> Membership:
    """Return the membership of a map at a size, by its definition."""
    table = with_positions(table)
    return Membership(table) if size == table.size else cached_for(table, _resampler)(size)


def table_at(table: MapTable, size: tuple[int, int]) -> MapTable:
    """Return the table of a map at a size, with all that kernels read."""
    return with_tiles(with_positions(table)) if size == table.size else membership_at(table, size).tiled_table
