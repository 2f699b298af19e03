"""The tiles of a `MapTable`: by compiled loops on the CPU, by torch operations on other devices."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .antialiasing import SmoothLabels
from .device_tiles import tiles_on_device
from .table import MapTable
from .tile import TILE
from .widths import blurs_of, reach_of

# tiles per task
_TASK_TILES = 64
_NONE = np.empty((0, 0, 0), np.int32)


def with_tiles(table: MapTable, most_planes: int | None = None) -> MapTable:
    """Add tiles to a table that has ids; on the CPU, return it without tiles if they exceed `most_planes` planes."""
    if table.starts is not None:
        return table
    assert table.positions is not None
    if table.positions.device.type != "cpu":
        tiles = tiles_on_device(table.positions, table.num_regions, table.widths, table.width_index)
        return table.replace_tiles(tiles)
    entries = _list_entries(table, 0)
    if most_planes is not None and _num_planes(entries) > most_planes:
        return table
    return _fill(table, entries, np.float32, (_NONE.astype(float), _NONE, _NONE.astype(float)))


def with_smooth_tiles(table: MapTable, smooth: SmoothLabels) -> MapTable:
    """Add float64 tiles of antialiased labels to a table that has ids, on the CPU; see `SmoothMembership`."""
    return _fill(table, _list_entries(table, 1), np.float64, tuple(map(to_array, smooth)))


def _list_entries(table: MapTable, margin: int) -> tuple[Any, Any, Any]:
    """Return starts, regions and planes as arrays; weights reach `margin` pixels beyond a label before the blur."""
    from .loops import list_regions  # loads numba

    assert table.positions is not None
    reaches = np.array([reach_of(width) + margin for width in table.widths])
    counts, regions = list_regions(to_array(table.positions), _width_array(table), reaches, table.num_regions)
    starts = np.zeros(len(counts) + 1, np.int32)
    np.cumsum(counts, out=starts[1:])
    is_shared = np.repeat(counts > 1, counts)
    return starts, regions, np.where(is_shared, np.cumsum(is_shared, dtype=np.int32) - 1, np.int32(-1))


def _num_planes(entries: tuple[Any, Any, Any]) -> int:
    return int(entries[2].max(initial=-1)) + 1


def _fill(table: MapTable, entries: tuple[Any, Any, Any], dtype: Any, smooth: Any) -> MapTable:
    """Return the table with tiles of these entries, and weights of a type."""
    from kcgs.compiled.tasks import ranges, run_tasks  # loads numba

    from .loops import fill_planes

    assert table.positions is not None
    weights = np.empty((_num_planes(entries), TILE * TILE), dtype)
    blurs = blurs_of((0.0,), table.positions.device) if table.blurs is None else table.blurs
    tiles = (*entries, weights)
    width_blurs = _width_array(table), to_array(blurs[:, 1:])
    loop = partial(fill_planes, to_array(table.positions), smooth, width_blurs, tiles)
    run_tasks(loop, ranges(len(entries[0]) - 1, _TASK_TILES))
    return table.replace_tiles(map(torch.from_numpy, tiles))


def _width_array(table: MapTable) -> Any:
    return _NONE if table.width_index is None else to_array(table.width_index)


def to_array(tensor: Tensor) -> Any:
    """Copy a tensor of any device to an array in C order, if it is not one already."""
    return tensor.cpu().contiguous().numpy()
