"""Membership s_r(x, y) of pixels in regions: its definition, and tables of tiles for the kernels.

`RegionMap` makes it, and documents the blur. A tile deep inside a region has s_r = 1 everywhere: it stores its label.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from .antialiasing import SmoothLabels
from .coverage import TILE, Coverage, make_coverage
from .widths import RADIUS_SIGMAS, find_widths

T = TypeVar("T")

# windows of a task, and tiles
_TASK_WINDOWS = 32
_TASK_TILES = 64


class TileMembership(NamedTuple):
    """Which regions occur in which tile, and the membership of its pixels where a tile holds several.

    Tiles are numbered in raster order, batch first: (b * tiles_y + ty) * tiles_x + tx.
    """

    keys: Tensor  # [K] int64, sorted: tile * num_regions + region
    mask_rows: Tensor  # [K] int64, row of `masks`, -1 where the region is alone in its tile
    masks: Tensor  # [P, tile * tile], the membership: bool (hard contours) or float64

    @classmethod
    def assemble(cls, single: Tensor, keys: Tensor, masks: Tensor) -> TileMembership:
        """Put the keys of tiles with one region between those of regions with masks."""
        all_keys, order = torch.cat([single, keys]).sort()
        rows = torch.arange(len(keys), device=keys.device)
        return cls(all_keys, torch.cat([torch.full_like(single, -1), rows])[order], masks)


class Levels(NamedTuple):
    """The widths of contours, and the one of each pixel."""

    widths: tuple[float, ...]  # pixels, ascending
    level: Tensor | None  # [B, H, W] int32, position in `widths`; None: one width everywhere


class Membership:
    """A label map and its contour widths, with tables for the kernels, made once and kept."""

    margin = 0  # pixels that what is blurred reaches farther than the labels

    def __init__(
        self,
        index: Tensor,
        num_regions: int,
        softness: float | Mapping[tuple[int, int], float] = 0.0,
    ) -> None:
        """Take the labels of pixels, (B, H, W), as integers 0 ... num_regions - 1.

        `softness` is the contour width in pixels, or that of each pair (a, b) of labels with a < b, 0 where absent.
        """
        self.index = index
        self.num_regions = num_regions
        self.softness = softness
        self._derived: dict[object, Any] = {}

    def __getstate__(self) -> dict[str, Any]:
        # without tables: torch moves the memory of tensors that it sends to another process, which arrays may share
        return {**vars(self), "_derived": {}}

    @property
    def levels(self) -> Levels:
        """Contour widths of the pixels."""
        return self.derived("levels", _find_levels)

    @property
    def smooth_labels(self) -> SmoothLabels | None:
        """Labels to blur in place of those of the map."""
        return None

    @property
    def radius(self) -> int:
        """Reach of the softest contour in pixels."""
        return self._reach(self.levels.widths[-1]) + self.margin

    def to(self, device: torch.device) -> Membership:
        """Return the same membership on `device`, without tables."""
        return Membership(self.index.to(device), self.num_regions, self.softness)

    def weights(self, batch: int, region: int, dtype: torch.dtype) -> Tensor:
        """Evaluate s_r of one region over one whole map, (H, W): the definition, without tables."""
        inside = self._inside(batch, region)
        widths, level = self.levels
        weights = torch.zeros_like(inside)
        for position, width in enumerate(widths):
            blurred = self._blur(inside, width)
            weights = blurred if level is None else torch.where(level[batch] == position, blurred, weights)
        return weights.to(dtype)

    def _inside(self, batch: int, region: int) -> Tensor:
        """Return what is blurred, (H, W) float64."""
        return (self.index[batch] == region).to(torch.float64)

    def _blur(self, inside: Tensor, width: float) -> Tensor:
        if width == 0.0:
            return inside
        axes = [torch.arange(n, device=inside.device) for n in inside.shape]
        rows, cols = (self._gaussian(axis[:, None] - axis[None, :], width) for axis in axes)
        total = rows.sum(1)[:, None] * cols.sum(1)[None, :]
        return (rows @ inside @ cols.T) / total

    def _reach(self, width: float) -> int:
        return math.ceil(RADIUS_SIGMAS * width)

    def _gaussian(self, offset: Tensor, width: float) -> Tensor:
        distance = offset.abs().to(torch.float64)
        gaussian = torch.exp(-0.5 * (distance / width) ** 2)
        return torch.where(distance <= self._reach(width), gaussian, 0.0)

    def tiles(self, tile: int) -> TileMembership:
        """Return the tables for square tiles of `tile` pixels."""
        return self.derived(("tiles", tile), lambda _: self._build_tiles(tile))

    def coverage(self) -> Coverage:
        """Return the table for tiles of 16 pixels, on the map's device."""
        return self.derived("coverage", lambda _: self._build_coverage())

    def full_map(self, batch: int, region: int, tile: int = 16) -> Tensor:
        """Assemble s_r of one region from the tables of tiles, (H, W) float64."""
        (maps, height, width), table = self.index.shape, self.tiles(tile)
        rows, cols = -(-height // tile), -(-width // tile)
        entries = (table.keys % self.num_regions == region).nonzero().flatten()
        tiles, mask_rows = table.keys[entries] // self.num_regions, table.mask_rows[entries]
        weights = torch.zeros(maps * rows * cols, tile * tile, dtype=torch.float64, device=self.index.device)
        weights[tiles] = 1.0
        is_mixed = mask_rows >= 0
        weights[tiles[is_mixed]] = table.masks[mask_rows[is_mixed]].double()
        image = weights.view(maps, rows, cols, tile, tile)[batch].transpose(1, 2).reshape(rows * tile, cols * tile)
        return image[:height, :width]

    def derived(self, key: object, build: Callable[[Membership], T]) -> T:
        """Return build(self), evaluated once for each key."""
        if key not in self._derived:
            self._derived[key] = build(self)
        value: T = self._derived[key]
        return value

    def _build_tiles(self, tile: int) -> TileMembership:
        place, reaches = self._place_tiles(tile)
        single, keys = self.list_keys(place, (tile, tile), reaches)
        masks = self.window_weights(place[keys // self.num_regions], keys % self.num_regions, (tile, tile)).flatten(1)
        return TileMembership.assemble(single, keys, masks.bool() if self.levels.widths == (0.0,) else masks)

    def _place_tiles(self, tile: int) -> tuple[Tensor, Tensor]:
        """Return map, first row and first column of each tile, (T, 3), and how far its pixels see, (T,)."""
        widths, level = self.levels
        maps, height, width = self.index.shape
        counts = (maps, -(-height // tile), -(-width // tile))
        place = torch.cartesian_prod(*[torch.arange(n, device=self.index.device) for n in counts])
        place[:, 1:] *= tile
        # the widest contour of a tile decides
        reaches = torch.tensor([self._reach(contour) + self.margin for contour in widths], device=place.device)
        widest = torch.zeros(len(place), dtype=torch.int64, device=place.device)
        if level is not None:
            widest = torch.nn.functional.max_pool2d(level.float(), tile, ceil_mode=True).flatten().long()
        return place, reaches[widest]

    def _build_coverage(self) -> Coverage:
        if self.index.device.type != "cpu":
            return make_coverage(
                self.index, self.num_regions, *find_widths(self.index, self.num_regions, self.softness)
            )
        from kcgs.compiled.tasks import ranges, run_tasks  # loads numba

        from .windows import fill_planes, list_regions

        index, (place, reaches) = _array(self.index), self._place_tiles(TILE)
        counts, regions = list_regions(index, place.numpy(), (TILE, TILE), reaches.numpy(), self.num_regions)
        starts = np.zeros(len(counts) + 1, np.int32)
        np.cumsum(counts, out=starts[1:])
        is_shared = np.repeat(counts > 1, counts)
        ends = np.cumsum(is_shared, dtype=np.int32)
        planes = np.where(is_shared, ends - 1, np.int32(-1))
        weights = np.empty((ends[-1], TILE * TILE), np.float32)
        arguments = index, *self._blur_arrays(), starts, regions, planes, weights
        run_tasks(partial(fill_planes, *arguments), ranges(len(counts), _TASK_TILES))
        return Coverage(*map(torch.from_numpy, (starts, regions, planes, weights)))

    def list_keys(self, place: Tensor, sides: Sequence[int], reaches: Tensor) -> tuple[Tensor, Tensor]:
        """List keys, tile * num_regions + region, of tiles with one region, and of tiles with several; both sorted.

        Args:
            place: image, first row and first column of each tile, (T, 3); at least one of its pixels is in the image.
            sides: height and width of a tile, in pixels.
            reaches: distance, in pixels, at which a region around a tile belongs to it, (T,).
        """
        from .windows import list_regions  # loads numba

        counts, regions = list_regions(
            _array(self.index), _array(place), (sides[0], sides[1]), _array(reaches), self.num_regions
        )
        keys = np.repeat(np.arange(len(counts)), counts) * self.num_regions + regions
        is_single = np.repeat(counts == 1, counts)
        single, several = (torch.from_numpy(part).to(place.device) for part in (keys[is_single], keys[~is_single]))
        return single, several

    def window_weights(self, place: Tensor, region: Tensor, span: Sequence[int]) -> Tensor:
        """Evaluate s_r over windows of `span` pixels, (P, *span) float64, of image, first row and first column, (P, 3).

        Windows may reach beyond the image, where s_r has no meaning.
        """
        from kcgs.compiled.tasks import ranges, run_tasks  # loads numba

        from .windows import fill_weights

        weights = np.zeros((len(region), *span))
        labels = self.smooth_labels
        none = np.empty((0, 0, 0))
        parts = (none, none.astype(np.int32), none) if labels is None else map(_array, labels)
        arguments = _array(self.index), *parts, *self._blur_arrays(), _array(place), _array(region), weights
        run_tasks(partial(fill_weights, *arguments), ranges(len(region), _TASK_WINDOWS))
        return torch.from_numpy(weights).to(region.device)

    def _blur_arrays(self) -> tuple[Any, Any]:
        """Return the levels of pixels and halves of blurs, as the loops over windows take them."""
        widths, level = self.levels
        offsets = torch.arange(self.radius + 1)
        taps = torch.stack([self._gaussian(offsets, width) if width else (offsets == 0).double() for width in widths])
        return np.empty((0, 0, 0), np.int32) if level is None else _array(level), taps.numpy()

    def read(self, pixels: Tensor, place: Tensor, span: Sequence[int]) -> Tensor:
        """Read (B, H, W) over windows, (P, *span), at places as of `window_weights`; the border repeats."""
        lines = [
            (first[:, None] + torch.arange(side, device=pixels.device)).clamp(0, length - 1)
            for first, side, length in zip(place.unbind(1)[1:], span, pixels.shape[1:], strict=True)
        ]
        return pixels[place[:, :1, None], lines[0][:, :, None], lines[1][:, None, :]]

    @property
    def variances(self) -> Tensor:
        """Squared widths of contours at pixels, (B, H, W) float64."""
        return self.derived("variances", _find_variances)


def _array(tensor: Tensor) -> Any:
    return tensor.cpu().contiguous().numpy()


def _find_levels(membership: Membership) -> Levels:
    """Give each pixel the width of its nearest contour.

    The nearest pixel that touches a contour has the same label: the way to another label crosses the contour earlier.
    So the two regions are that pixel's, and that of the first of its neighbours that differs.
    """
    if not isinstance(membership.softness, Mapping):
        return Levels((membership.softness,), None)
    from .nearest import spread  # loads numba

    maps = _array(membership.index)
    other = _neighbor_labels(maps)
    touches = other >= 0
    own, beside = maps[touches].astype(np.int64), other[touches]
    keys = np.minimum(own, beside) * membership.num_regions + np.maximum(own, beside)
    pairs, pair_index = np.unique(keys, return_inverse=True)
    pair_widths = [membership.softness.get(divmod(pair, membership.num_regions), 0.0) for pair in pairs.tolist()]
    if len(set(pair_widths)) < 2:
        return Levels((pair_widths[0] if pair_widths else 0.0,), None)
    widths, pair_levels = np.unique(pair_widths, return_inverse=True)
    contours, level = np.full(maps.shape, -1, np.int32), np.zeros(maps.shape, np.int32)
    contours[touches] = pair_levels[pair_index]
    spread(contours, level)
    return Levels(tuple(widths.tolist()), torch.from_numpy(level).to(membership.index.device))


def _find_variances(membership: Membership) -> Tensor:
    widths, level = membership.levels
    squares = torch.tensor(widths, dtype=torch.float64, device=membership.index.device).square()
    return squares.expand(membership.index.shape) if level is None else squares[level.long()]


def _neighbor_labels(labels: Any) -> Any:
    """Return the first label beside each pixel (above, left, right, below) that differs from its own; -1: none."""
    other = np.full_like(labels, -1)
    later = slice(1, None)
    earlier = slice(None, -1)
    every = slice(None)
    for pixel, neighbour in (
        ((..., later, every), (..., earlier, every)),
        ((..., every, later), (..., every, earlier)),
        ((..., every, earlier), (..., every, later)),
        ((..., earlier, every), (..., later, every)),
    ):
        differs = (labels[pixel] != labels[neighbour]) & (other[pixel] < 0)
        np.copyto(other[pixel], labels[neighbour], where=differs)
    return other
