"""Soft membership at another size: s_r of the map's own pixels, interpolated bilinearly."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .membership import Membership, TileMembership

_CHUNK_ELEMENTS = 1 << 21


class _Axis(NamedTuple):
    """Where the pixels of one axis lie between those of the map."""

    low: Tensor  # [n] int64, the neighbour before
    high: Tensor  # [n] int64, the one after, both clamped to the map
    weight: Tensor  # [n] float64, of the one after


class Resampled(Membership):
    """Membership of a soft map at another size.

    A point between the centres of four pixels has the bilinear mean of their memberships; beyond the outermost centres
    those of the border are held. At the size of the map that would be the map itself.
    """

    def __init__(self, index: Tensor, source: Membership) -> None:
        """Take labels at the new size, (B, H, W), and the map at its own."""
        super().__init__(index, source.num_regions, source.softness)
        self.source = source

    def to(self, device: torch.device) -> Resampled:
        """Return the same membership on `device`, tables not carried along."""
        return Resampled(self.index.to(device), self.source.to(device))

    def weights(self, batch: int, region: int, dtype: torch.dtype) -> Tensor:
        """Evaluate s_r of one region over one whole map, (H, W): the definition, without tables."""
        weights = self.source.weights(batch, region, torch.float64)
        down, across = (
            _matrix(axis, torch.zeros(1, dtype=torch.int64, device=weights.device), n)[0]
            for axis, n in zip(self._axes(1), weights.shape, strict=True)
        )
        return (down @ weights @ across.T).to(dtype)

    def _axes(self, tile: int) -> tuple[_Axis, _Axis]:
        """Return rows and columns, filled up with the last one to whole tiles."""
        sizes = zip(self.index.shape[1:], self.source.index.shape[1:], strict=True)
        return tuple(_axis(new, old, tile, self.index.device) for new, old in sizes)  # type: ignore[return-value]

    def _build_tiles(self, tile: int) -> TileMembership:
        maps = self.index.shape[0]
        axes = self._axes(tile)
        firsts = [axis.low[::tile] for axis in axes]
        spans = [int((axis.high[tile - 1 :: tile] - first).max()) + 1 for axis, first in zip(axes, firsts, strict=True)]
        down, across = (
            _matrix(_Axis(*(part.view(-1, tile) for part in axis)), first, span)
            for axis, first, span in zip(axes, firsts, spans, strict=True)
        )  # [tiles of the axis, tile, span] each
        place = torch.cartesian_prod(*[torch.arange(n, device=firsts[0].device) for n in (maps, *map(len, firsts))])
        batch, row, col = place.unbind(1)
        source, corners = self.source, (firsts[0][row], firsts[1][col])
        k = source.supersample
        corner, sides = (batch, k * corners[0], k * corners[1]), [k * span for span in spans]
        numbers = torch.arange(len(batch), device=batch.device)
        single, keys = source.list_keys(numbers, corner, sides, source.radius * k)
        tiles, region = keys // self.num_regions, keys % self.num_regions
        masks = torch.zeros(len(keys), tile * tile, dtype=torch.float64, device=keys.device)
        step = max(1, _CHUNK_ELEMENTS // (spans[0] * spans[1] + tile * tile))
        for chunk in torch.arange(len(keys), device=keys.device).split(step):
            t, y, x = tiles[chunk], row[tiles[chunk]], col[tiles[chunk]]
            window = self.source.window_weights(batch[t], region[chunk], firsts[0][y], firsts[1][x], spans)
            masks[chunk] = (down[y] @ window @ across[x].mT).flatten(1)
        seen = (masks > 0).any(1)
        return TileMembership.assemble(single, keys[seen], masks[seen])


def _axis(new: int, old: int, tile: int, device: torch.device) -> _Axis:
    at = (torch.arange(new, device=device, dtype=torch.float64) + 0.5) * (old / new) - 0.5
    at = torch.nn.functional.pad(at, (0, -new % tile), value=float(at[-1]))
    low = at.floor()
    return _Axis(low.long().clamp(0, old - 1), (low.long() + 1).clamp(0, old - 1), at - low)


def _matrix(axis: _Axis, first: Tensor, span: int) -> Tensor:
    """Matrix from the pixels of a window to those between them, (tiles, n, span)."""
    at = torch.arange(span, device=first.device) + first.view(-1, 1, 1)
    low, high = (side.reshape(len(first), -1, 1) == at for side in axis[:2])
    weight = axis.weight.reshape(len(first), -1, 1)
    return low * (1 - weight) + high * weight
