"""Maps as arguments of functions: a RegionMap, or labels that a map is made from."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from kcgs._labels import check_labels, is_label_source
from kcgs.errors import InvalidArgumentType

from .regions import RegionMap
from .table import MapTable


def as_region_map(value: object, name: str = "regions") -> RegionMap | None:
    """Return a RegionMap or None unchanged, and labels as a map with hard contours; `name` is for errors."""
    if value is None or isinstance(value, RegionMap):
        return value
    if is_label_source(value):
        return RegionMap(check_labels(name, value))
    raise InvalidArgumentType(name, "a RegionMap, a label map or None", type(value).__name__)


def table_and_size(regions: object) -> tuple[MapTable, tuple[int, int]]:
    """Return the table of a map, or a table of labels alone, and the size at which it is sampled."""
    if isinstance(regions, RegionMap):
        return regions._table, regions.size
    if isinstance(regions, (Tensor, np.ndarray)):  # graphs of torch 2.7 know no other form
        table = MapTable(check_labels("regions", regions, values=False))
        return table, table.size
    hint = ": RegionMap(regions) reads it, once for all renders" if is_label_source(regions) else ""
    raise InvalidArgumentType("regions", "a RegionMap, a Tensor, an array or None", f"{type(regions).__name__}{hint}")
