"""`MapTable`: a label map as tensors, from a RegionMap to the innermost loop."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from kcgs._labels import check_labels

from .labels import compact
from .tile import TILE


class MapTable(NamedTuple):
    """A label map as tensors; in a table of labels alone, all others are None.

    `with_positions` adds ids and positions, `with_tiles` adds `TILE_FIELDS`: the regions of each tile of 16 pixels, and
    the membership of its pixels where a tile has several. Tiles are numbered in raster order, map first. Weights beyond
    the image have no meaning.

    To add a field, add it here, and to `PER_MAP` or `SHARED` if it cannot be made from the other fields: the operator's
    schema, arguments and vmap follow.
    """

    labels: Tensor  # [H, W] or [maps, H, W] int64; a RegionMap's are never written to
    blurs: Tensor | None = None  # [widths, 2 + reach] float64, as of `blurs_of`, ascending; None: hard contours
    width_index: Tensor | None = None  # [maps, H, W] int32, row of `blurs` for each pixel; None: the first
    ids: Tensor | None = None  # [R] int64, sorted
    positions: Tensor | None = None  # [maps, H, W] int32, of each pixel's label among the ids
    starts: Tensor | None = None  # [maps * tiles + 1] int32, first entry of each tile
    regions: Tensor | None = None  # [K] int32, ascending within a tile: position of the region among the ids
    planes: Tensor | None = None  # [K] int32, row of `weights`; -1 where the region is alone in its tile, with weight 1
    weights: Tensor | None = None  # [P, 256] float32, membership of the tile's pixels in the region

    @property
    def shape(self) -> tuple[int, int, int]:
        """(maps, H, W)."""
        maps = self.labels.shape[0] if self.labels.ndim == 3 else 1
        return maps, self.labels.shape[-2], self.labels.shape[-1]

    @property
    def size(self) -> tuple[int, int]:
        """(H, W)."""
        return self.labels.shape[-2], self.labels.shape[-1]

    @property
    def num_regions(self) -> int:
        """R, of a table with ids."""
        assert self.ids is not None
        return len(self.ids)

    @property
    def widths(self) -> tuple[float, ...]:
        """The widths of contours in pixels; the host waits for the device."""
        return (0.0,) if self.blurs is None else tuple(self.blurs[:, 0].tolist())

    @property
    def tiles(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """`TILE_FIELDS` of a table that has them."""
        starts, regions, planes, weights = self.starts, self.regions, self.planes, self.weights
        assert starts is not None and regions is not None and planes is not None and weights is not None
        return starts, regions, planes, weights

    def apply(self, function: Callable[[Tensor], Tensor]) -> MapTable:
        """Return the table with a function applied to each of its tensors."""
        return MapTable._make(None if part is None else function(part) for part in self)

    def replace_tiles(self, tiles: Iterable[Tensor | None]) -> MapTable:
        """Return the table with other tiles, in the order of `TILE_FIELDS`."""
        fields: dict[str, Any] = dict(zip(TILE_FIELDS, tiles, strict=True))
        return self._replace(**fields)

    def without_tiles(self) -> MapTable:
        """Return the table without its tiles."""
        return self.replace_tiles([None] * len(TILE_FIELDS))


# the fields from which all others can be made: those with a part for each map, and those that all maps share
PER_MAP = ("labels", "width_index")
SHARED = ("blurs",)
# the regions of tiles, and the membership of their pixels
TILE_FIELDS = ("starts", "regions", "planes", "weights")


def with_positions(table: MapTable) -> MapTable:
    """Return a table with ids and positions; a table of labels alone is checked."""
    if table.ids is not None:
        return table
    labels = table.labels
    if not labels.is_cpu:
        check_labels("regions", labels)
    ids, positions = compact(labels)
    if labels.is_cpu and int(ids.numpy()[0]) < 0:  # the least id, in place of another pass over the pixels
        check_labels("regions", labels)
    return table._replace(ids=ids, positions=positions.view(table.shape))


def full_map(table: MapTable, batch: int, region: int) -> Tensor:
    """Assemble the membership of one region from the tiles, (H, W) float64."""
    _, height, width = table.shape
    rows, cols = -(-height // TILE), -(-width // TILE)
    starts, regions, planes, weights = table.tiles
    image = weights.new_zeros(rows * cols, TILE * TILE, dtype=torch.float64)
    entries = slice(int(starts[batch * rows * cols]), int(starts[(batch + 1) * rows * cols]))
    tile = torch.repeat_interleave(starts[batch * rows * cols :][: rows * cols + 1].diff())
    is_own = regions[entries] == region
    tile, plane = tile[is_own], planes[entries][is_own].long()
    image[tile[plane < 0]] = 1.0
    image[tile[plane >= 0]] = weights[plane[plane >= 0]].double()
    image = image.view(rows, cols, TILE, TILE).transpose(1, 2).reshape(rows * TILE, cols * TILE)
    return image[:height, :width]
