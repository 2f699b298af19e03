"""Membership s_r(x, y) of pixels in regions: its definition, and the table of tiles that kernels and decoders read.

`RegionMap` documents the blur. A tile deep inside a region has s_r = 1 everywhere: it has no plane.
"""

from __future__ import annotations

import functools
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .antialiasing import SmoothLabels
from .coverage import TILE, Coverage, make_coverage
from .labels import positions_of
from .widths import blurs_of, reach_of

# tiles of a task
_TASK_TILES = 64
_NONE = np.empty((0, 0, 0), np.int32)


class Membership:
    """The labels of pixels and the widths of their contours, at one size."""

    margin = 0  # pixels that what is blurred reaches farther than the labels
    plane_dtype: type[np.floating[Any]] = np.float32

    def __init__(
        self, labels: Tensor, ids: Tensor, blurs: Tensor | None = None, width_index: Tensor | None = None
    ) -> None:
        """Take labels, (H, W) or (maps, H, W), their sorted ids, and widths as in `MapOperands`."""
        self._labels = labels
        self.ids = ids
        self._blurs = blurs
        self.width_index = width_index

    @property
    def num_regions(self) -> int:
        """Number of ids."""
        return len(self.ids)

    @property
    def smooth_labels(self) -> SmoothLabels | None:
        """Labels to blur in place of those of the map, with positions among the ids."""
        return None

    @functools.cached_property
    def labels(self) -> Tensor:
        """The labels, (maps, H, W)."""
        return self._labels if self._labels.ndim == 3 else self._labels[None]

    @functools.cached_property
    def blurs(self) -> Tensor:
        """A row for each width, as of `blurs_of`."""
        return blurs_of((0.0,), self._labels.device) if self._blurs is None else self._blurs

    @functools.cached_property
    def widths(self) -> tuple[float, ...]:
        """The widths of contours, in pixels."""
        return (0.0,) if self._blurs is None else tuple(self._blurs[:, 0].tolist())

    @functools.cached_property
    def index(self) -> Tensor:
        """Position of each pixel's label among the ids, (maps, H, W) int32."""
        return positions_of(self.labels, self.ids).int()

    @functools.cached_property
    def coverage(self) -> Coverage:
        """The table for tiles of 16 pixels, made on the map's device."""
        if self.index.device.type == "cpu":
            return self._make_coverage()
        return make_coverage(self.index, self.num_regions, self.widths, self.width_index)

    @property
    def radius(self) -> int:
        """Reach of the softest contour in pixels."""
        return reach_of(self.widths[-1]) + self.margin

    def weights(self, batch: int, region: int, dtype: torch.dtype) -> Tensor:
        """Evaluate s_r of one region over one whole map, (H, W): the definition, without tables."""
        inside = self._inside(batch, region)
        weights = torch.zeros_like(inside)
        for position, width in enumerate(self.widths):
            blurred = self._blur(inside, width)
            is_own = None if self.width_index is None else self.width_index[batch] == position
            weights = blurred if is_own is None else torch.where(is_own, blurred, weights)
        return weights.to(dtype)

    def _inside(self, batch: int, region: int) -> Tensor:
        """Return what is blurred, (H, W) float64."""
        return (self.index[batch] == region).to(torch.float64)

    def _blur(self, inside: Tensor, width: float) -> Tensor:
        if width == 0.0:
            return inside
        axes = [torch.arange(n, device=inside.device) for n in inside.shape]
        rows, cols = (_gaussian(axis[:, None] - axis[None, :], width) for axis in axes)
        total = rows.sum(1)[:, None] * cols.sum(1)[None, :]
        return (rows @ inside @ cols.T) / total

    def full_map(self, batch: int, region: int) -> Tensor:
        """Assemble s_r of one region from the table, (H, W) float64."""
        height, width = self.labels.shape[1:]
        rows, cols = -(-height // TILE), -(-width // TILE)
        starts, regions, planes, weights = self.coverage
        image = weights.new_zeros(rows * cols, TILE * TILE, dtype=torch.float64)
        entries = slice(int(starts[batch * rows * cols]), int(starts[(batch + 1) * rows * cols]))
        tile = torch.repeat_interleave(starts[batch * rows * cols :][: rows * cols + 1].diff())
        is_own = regions[entries] == region
        tile, plane = tile[is_own], planes[entries][is_own].long()
        image[tile[plane < 0]] = 1.0
        image[tile[plane >= 0]] = weights[plane[plane >= 0]].double()
        image = image.view(rows, cols, TILE, TILE).transpose(1, 2).reshape(rows * TILE, cols * TILE)
        return image[:height, :width]

    @functools.cached_property
    def _entries(self) -> tuple[Any, Any, Any]:
        """Starts, regions and planes of the table, as arrays."""
        from .loops import list_regions  # loads numba

        reaches = np.array([reach_of(width) + self.margin for width in self.widths])
        counts, regions = list_regions(to_array(self.index), self._width_array, reaches, self.num_regions)
        starts = np.zeros(len(counts) + 1, np.int32)
        np.cumsum(counts, out=starts[1:])
        is_shared = np.repeat(counts > 1, counts)
        return starts, regions, np.where(is_shared, np.cumsum(is_shared, dtype=np.int32) - 1, np.int32(-1))

    @property
    def _width_array(self) -> Any:
        return _NONE if self.width_index is None else to_array(self.width_index)

    @property
    def num_planes(self) -> int:
        """Planes of the table, on the CPU."""
        return int(self._entries[2].max(initial=-1)) + 1

    def _make_coverage(self) -> Coverage:
        from kcgs.compiled.tasks import ranges, run_tasks  # loads numba

        from .loops import fill_planes

        starts, regions, planes = self._entries
        weights = np.empty((self.num_planes, TILE * TILE), self.plane_dtype)
        smooth = (_NONE.astype(float), _NONE, _NONE.astype(float))
        if self.smooth_labels is not None:
            smooth = tuple(map(to_array, self.smooth_labels))
        arrays = to_array(self.index), smooth, self._width_array, to_array(self.blurs[:, 1:])
        fill = partial(fill_planes, *arrays, starts, regions, planes, weights)
        run_tasks(fill, ranges(len(starts) - 1, _TASK_TILES))
        return Coverage(*map(torch.from_numpy, (starts, regions, planes, weights)))

    @property
    def variances(self) -> Tensor:
        """Squared widths of contours at pixels, (maps, H, W) float64."""
        squares = self.blurs[:, 0].square()
        return squares.expand(self.labels.shape) if self.width_index is None else squares[self.width_index.long()]


def to_array(tensor: Tensor) -> Any:
    """Return a tensor of any device as an array in C order."""
    return tensor.cpu().contiguous().numpy()


def _gaussian(offset: Tensor, width: float) -> Tensor:
    distance = offset.abs().to(torch.float64)
    gaussian = torch.exp(-0.5 * (distance / width) ** 2)
    return torch.where(distance <= reach_of(width), gaussian, 0.0)
