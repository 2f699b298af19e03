"""How much of each pixel belongs to each region: s_r(x, y).

Hard (softness 0): s_r = [M = r]. Soft: the Gaussian blur of [M = r], of standard deviation `softness` pixels, cut at
`RADIUS_SIGMAS` standard deviations and normalised to sum to one over the regions, so that outside the image nothing
weighs. A tile deep inside a region has s_r = 1 everywhere and is stored as nothing but its label.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

T = TypeVar("T")

RADIUS_SIGMAS = 4.0
_PATCH_ELEMENTS = 1 << 22


class TileMembership(NamedTuple):
    """Which regions occur in which tile, and their weights where a tile holds several.

    Tiles are numbered in raster order, batch first: (b * tiles_y + ty) * tiles_x + tx.
    """

    keys: Tensor  # [K] int64, sorted: tile * num_regions + region
    plane: Tensor  # [K] int64, row of `planes`, -1 where the region is alone in its tile
    planes: Tensor  # [P, tile * tile] bool (hard) or float64 (soft)


class Membership:
    """Compact label map and contour width, with the tables the kernels need, made once and kept."""

    def __init__(self, index: Tensor, num_regions: int, softness: float = 0.0) -> None:
        """Take `index` (B, H, W), integers 0 ... num_regions - 1."""
        self.index = index
        self.num_regions = num_regions
        self.softness = softness
        self._derived: dict[object, Any] = {}

    @property
    def radius(self) -> int:
        """Reach of the soft contour in pixels."""
        return math.ceil(RADIUS_SIGMAS * self.softness)

    def to(self, device: torch.device) -> Membership:
        """Return the same membership on `device`, tables not carried along."""
        return Membership(self.index.to(device), self.num_regions, self.softness)

    def weights(self, batch: int, region: int, dtype: torch.dtype) -> Tensor:
        """Evaluate s_r of one region over one whole map, (H, W): the definition, without tables."""
        inside = (self.index[batch] == region).to(torch.float64)
        if self.softness == 0.0:
            return inside.to(dtype)
        rows, cols = (self._blur_matrix(n, inside.device) for n in inside.shape)
        total = rows.sum(1)[:, None] * cols.sum(1)[None, :]
        return ((rows @ inside @ cols.T) / total).to(dtype)

    def _blur_matrix(self, n: int, device: torch.device) -> Tensor:
        at = torch.arange(n, device=device, dtype=torch.float64)
        distance = (at[:, None] - at[None, :]).abs()
        return torch.where(distance <= self.radius, self._gaussian(distance), 0.0)

    def _gaussian(self, distance: Tensor) -> Tensor:
        return torch.exp(-0.5 * (distance / self.softness) ** 2)

    def tiles(self, tile: int) -> TileMembership:
        """Tables for square tiles of `tile` pixels."""
        return self.derived(("tiles", tile), lambda _: self._build_tiles(tile))

    def derived(self, key: object, build: Callable[[Membership], T]) -> T:
        """Return what `build` makes of this membership, made once and kept."""
        if key not in self._derived:
            self._derived[key] = build(self)
        value: T = self._derived[key]
        return value

    def _build_tiles(self, tile: int) -> TileMembership:
        # windows: every tile with the halo that its soft contours can see; -1 is outside the image
        height, width = self.index.shape[1:]
        radius = self.radius
        tiles_y, tiles_x = -(-height // tile), -(-width // tile)
        border = (radius, tiles_x * tile - width + radius, radius, tiles_y * tile - height + radius)
        span = tile + 2 * radius

        def windows(outside: int) -> Tensor:  # [B, ty, tx, span, span], a view
            padded = torch.nn.functional.pad(self.index, border, value=outside)
            return padded.unfold(1, span, tile).unfold(2, span, tile)

        high = windows(-1).amax((-1, -2)).flatten()
        low = windows(self.num_regions).amin((-1, -2)).flatten()
        single = (low == high).nonzero().flatten()
        mixed = (low != high).nonzero().flatten()
        keys, planes = [single * self.num_regions + high[single]], []
        step = max(1, _PATCH_ELEMENTS // (span * span))
        for some in mixed.split(step):
            image, place = some // (tiles_y * tiles_x), some % (tiles_y * tiles_x)
            patches = windows(-1)[image, place // tiles_x, place % tiles_x]
            held = torch.unique((some[:, None] * self.num_regions + patches.flatten(1))[patches.flatten(1) >= 0])
            keys.append(held)
            slot = torch.searchsorted(some, held // self.num_regions)
            planes.append(self._planes(patches, slot, held % self.num_regions, tile))

        rows = torch.arange(sum(map(len, planes)), device=self.index.device)
        all_keys, order = torch.cat(keys).sort()
        plane = torch.cat([torch.full_like(single, -1), rows])[order]
        empty = self._planes(windows(-1)[:1, 0, 0], rows[:0], rows[:0], tile)
        return TileMembership(all_keys, plane, torch.cat(planes) if planes else empty)

    def _planes(self, patches: Tensor, slot: Tensor, region: Tensor, tile: int) -> Tensor:
        span, radius = patches.shape[-1], self.radius
        dtype = torch.bool if self.softness == 0.0 else torch.float64
        planes = torch.empty(len(slot), tile * tile, device=patches.device, dtype=dtype)
        step = max(1, _PATCH_ELEMENTS // (span * span))
        if self.softness == 0.0:
            for start in range(0, len(slot), step):
                part = slice(start, start + step)
                planes[part] = (patches[slot[part]] == region[part, None, None]).flatten(1)
            return planes
        at = torch.arange(span, device=patches.device, dtype=torch.float64)
        distance = (at[radius : radius + tile, None] - at[None, :]).abs()
        blur = torch.where(distance <= radius, self._gaussian(distance), 0.0)  # [tile, span]
        total = blur @ (patches >= 0).to(blur.dtype) @ blur.T
        for start in range(0, len(slot), step):
            part = slice(start, start + step)
            mask = (patches[slot[part]] == region[part, None, None]).to(blur.dtype)
            planes[part] = ((blur @ mask @ blur.T) / total[slot[part]].clamp_min(1e-300)).flatten(1)
        return planes
