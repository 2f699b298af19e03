"""What rendering derives from a label map, kept on the tensor of labels that a RegionMap owns."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from kcgs.kernels import Membership

# of a map, its own among them: a viewer renders at ever new sizes
_MOST_SIZES = 4


class MapTables(NamedTuple):
    """The ids of a map, where each is among them, and what the kernels evaluate."""

    ids: Tensor  # [R] int64, sorted
    table: Tensor | None  # from id + 1 to position, -1 at both ends; None where ids are large
    membership: Membership
    whole: bool = True  # False: a map sampled at another size, where small regions may be lost

    def to(self, device: torch.device) -> MapTables:
        """Return the same tables on `device`."""
        table = None if self.table is None else self.table.to(device)
        return self._replace(ids=self.ids.to(device), table=table, membership=self.membership.to(device))

    def index_of(self, region_ids: Tensor) -> Tensor:
        """Return the position of each id among `ids`, -1 where the map does not hold it."""
        if self.table is not None and self.table.device.type == "cpu" and not torch.compiler.is_compiling():
            # numpy takes a third of the time, and wakes no threads of torch's, which would spin beside the kernel's
            return torch.from_numpy(self.table.numpy().take(region_ids.long().numpy() + 1, mode="clip"))
        if self.table is not None:
            return self.table[(region_ids.long() + 1).clamp(0, len(self.table) - 1)]
        places = torch.searchsorted(self.ids, region_ids.contiguous()).clamp_max(len(self.ids) - 1)
        return torch.where(self.ids[places] == region_ids, places, -1)


def tables_by_size(labels: Any) -> dict[tuple[int, int, bool], MapTables] | None:
    """Return the tables kept on labels, by height, width and whether contours are crisp.

    None where the labels are not those of a RegionMap: whoever else holds them may write to them.
    """
    return getattr(labels, "kcgs_tables", None)


def keep_tables(labels: Any, size: tuple[int, int], crisp: bool, tables: MapTables) -> None:
    """Keep the tables of a map at a size on its labels, and those of few other sizes."""
    kept = tables_by_size(labels)
    if kept is None:
        kept = labels.kcgs_tables = {}
    kept[*size, crisp] = tables
    if len(kept) > _MOST_SIZES:
        kept.pop(list(kept)[1], None)  # not the first, the map's own; another thread may have been before
