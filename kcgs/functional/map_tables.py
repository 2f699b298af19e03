"""What rendering derives from a label map, kept beside the tensor of its labels for as long as that lives."""

from __future__ import annotations

import weakref
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

from kcgs.kernels import Membership

from .softness import is_crisp


class MapTables(NamedTuple):
    """The ids of a map, where each is among them, and what the kernels evaluate."""

    ids: Tensor  # [R] int64, sorted
    table: Tensor | None  # from small ids to positions, -1 at the end
    membership: Membership
    whole: bool = True  # False: a map sampled at another size, where small regions may be lost

    def to(self, device: torch.device) -> MapTables:
        """Return the same tables on `device`."""
        table = None if self.table is None else self.table.to(device)
        return self._replace(ids=self.ids.to(device), table=table, membership=self.membership.to(device))

    def index_of(self, region_ids: Tensor) -> Tensor:
        """Return the position of each id among `ids`, -1 where the map does not hold it."""
        if self.table is not None:
            # not self.table[...]: that wakes torch's threads, which then spin beside the kernel's
            places = region_ids.clamp(-1, len(self.table) - 1).flatten() % len(self.table)
            return self.table.index_select(0, places).view(region_ids.shape)
        places = torch.searchsorted(self.ids, region_ids.contiguous()).clamp_max(len(self.ids) - 1)
        return torch.where(self.ids[places] == region_ids, places, -1)


class _Kept(NamedTuple):
    version: Any  # of labels made in inference mode, which count no writes, a copy
    widths: Tensor | None
    tables: MapTables


# a viewer renders at ever new sizes
_MOST_SIZES = 4
_kept: WeakIdKeyDictionary = WeakIdKeyDictionary()


def keep_tables(
    labels: Tensor, widths: Tensor | None, supersample: int, size: tuple[int, int], tables: MapTables
) -> None:
    """Keep the tables of a map at a size, and of few others; `widths` as the operator has them."""
    sizes = _kept.setdefault(labels, {})
    sizes[supersample, *size, is_crisp(widths)] = _Kept(
        labels.clone() if labels.is_inference() else _version(labels), widths, tables
    )
    if len(sizes) > _MOST_SIZES:
        sizes.pop(list(sizes)[1], None)  # not the first, the map's own; another thread may have been before


def find_tables(labels: Tensor, widths: Tensor | None, supersample: int, size: tuple[int, int]) -> MapTables | None:
    """Return the tables of a map at a size, unless there are none, or the labels were written to since."""
    kept: _Kept | None = _kept.get(labels, {}).get((supersample, *size, is_crisp(widths)))
    if kept is None or not (
        torch.equal(kept.version, labels) if labels.is_inference() else kept.version == _version(labels)
    ):
        return None
    if (
        kept.widths is not widths
        and not is_crisp(widths)
        and (widths is None or kept.widths is None or not torch.equal(kept.widths, widths))
    ):
        return None
    return kept.tables


class _Index(NamedTuple):
    of: Any  # weak reference to the ids of the map
    version: tuple[int, int]
    places: Tensor
    least: int


_indices: WeakIdKeyDictionary = WeakIdKeyDictionary()


def find_index(tables: MapTables, region_ids: Tensor) -> tuple[Tensor, int]:
    """Return the position of each id in a map, (B, N), and the least of them; on CUDA, which is not waited for, -1.

    Kept beside the tensor of the ids, until it is written to or goes with another map.
    """
    kept: _Index | None = _indices.get(region_ids)
    if kept is not None and kept.of() is tables.ids and kept.version == _version(region_ids):
        return kept.places, kept.least
    index = tables.index_of(region_ids if region_ids.ndim == 2 else region_ids.unsqueeze(0))
    least = (int(index.min()) if index.numel() else 0) if index.device.type == "cpu" else -1
    if not region_ids.is_inference():
        _indices[region_ids] = _Index(weakref.ref(tables.ids), _version(region_ids), index, least)
    return index, least


def _version(tensor: Tensor) -> tuple[int, int]:
    # the address, too: `tensor.data = other` counts as no write
    return tensor._version, tensor.data_ptr()
