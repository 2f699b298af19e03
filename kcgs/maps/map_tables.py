"""What rendering derives from a label map at one size."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from kcgs._labels import check_labels

from .labels import compact, sample_labels
from .membership import Membership
from .resampled import Resampled
from .softness import PairSoftness, check_softness, scaled_softness, softness_of

_CACHED_VIEWS = 3  # of a map: a viewer renders at ever new sizes


class MapOperands(NamedTuple):
    """A map as the operator takes it."""

    labels: Tensor  # [H, W] or [B, H, W] int64, of the map at its own size; nobody writes to those of a RegionMap
    softness: Tensor | None  # float64, as `softness_tensor` makes it; None: hard contours
    size: tuple[int, int]  # (height, width) that the map is sampled at


class MapTables(NamedTuple):
    """The regions of a map, and which of them each pixel belongs to."""

    ids: Tensor  # [R] int64, sorted
    positions: (
        Tensor | None
    )  # from id + 1 to its position among `ids`, -1 at both ends; None: ids are large, or not on the CPU
    softness: float | PairSoftness
    membership: Membership

    def to(self, device: torch.device) -> MapTables:
        """Return the same tables on `device`."""
        positions = None if self.positions is None else self.positions.to(device)
        return self._replace(ids=self.ids.to(device), positions=positions, membership=self.membership.to(device))

    def index_of(self, region_ids: Tensor) -> Tensor:
        """Return the position of each id among `ids`, -1 where the map does not hold it."""
        if self.positions is None:
            places = torch.searchsorted(self.ids, region_ids.contiguous()).clamp_max(len(self.ids) - 1)
            return torch.where(self.ids[places] == region_ids, places, -1)
        if self.positions.device.type == "cpu" and not torch.compiler.is_compiling():
            # numpy takes a third of the time, and wakes no threads of torch's, which would spin beside the kernel's
            return torch.from_numpy(self.positions.numpy().take(region_ids.long().numpy() + 1, mode="clip"))
        return self.positions[(region_ids.long() + 1).clamp(0, len(self.positions) - 1)]


class TableCache:
    """The tables of one map: at its own size, and at the other sizes added last.

    It is an attribute of the labels that a RegionMap owns, since the operator receives these and not the map.
    """

    def __init__(self, original: MapTables) -> None:
        self.original = original
        self._views: dict[tuple[int, int], MapTables] = {}

    @staticmethod
    def of(labels: Tensor) -> TableCache | None:
        """Return the cache of labels that a RegionMap owns; None: of others, which their owner may write to."""
        return getattr(labels, "kcgs_tables", None)

    def attach(self, labels: Any) -> None:
        """Make this the cache of labels."""
        labels.kcgs_tables = self

    def view(self, size: tuple[int, int]) -> MapTables | None:
        """Return the tables at a size."""
        return self._views.get(size)

    def add(self, size: tuple[int, int], tables: MapTables) -> None:
        """Add a size, in place of the oldest where there are too many."""
        # a new dict: another thread may read the present one
        self._views = dict([*self._views.items(), (size, tables)][-_CACHED_VIEWS:])


def tables_at(operands: MapOperands) -> MapTables:
    """Return the tables of a map at its size, cached where a RegionMap owns the labels."""
    labels, softness, size = operands
    cache = TableCache.of(labels)
    if cache is None:
        check_labels("regions", labels)
        return _view(make_tables(labels, softness_of(softness)), operands)
    tables = cache.view(size)
    if tables is None:
        tables = _view(cache.original, operands)
        cache.add(size, tables)
    return tables


def _view(original: MapTables, operands: MapOperands) -> MapTables:
    """Return the tables of a map at a size for those at its own."""
    labels, _, size = operands
    return original if size == labels.shape[-2:] else resample(original, labels, size)[1]


def make_tables(labels: Tensor, softness: object) -> MapTables:
    """Derive the tables of a map at its own size."""
    ids, index, positions = compact(labels)
    softness = check_softness(softness, ids)
    by_index: float | dict[tuple[int, int], float]
    if isinstance(softness, PairSoftness):
        position = {region: place for place, region in enumerate(ids.tolist())}
        by_index = {(position[a], position[b]): value for (a, b), value in softness.items()}
    else:
        by_index = softness
    membership = Membership(index if index.ndim == 3 else index[None], len(ids), by_index)
    return MapTables(ids, positions, softness, membership)


def resample(tables: MapTables, labels: Tensor, size: tuple[int, int]) -> tuple[Tensor, MapTables]:
    """Return the labels and the tables of a map at another size: see `RegionMap.resize`."""
    sampled = sample_labels(labels, *size)
    index = tables.index_of(sampled).to(torch.int32)
    membership = Resampled(index if index.ndim == 3 else index[None], tables.membership)
    softness = scaled_softness(tables.softness, membership.ratio)
    return sampled, tables._replace(softness=softness, membership=membership)
