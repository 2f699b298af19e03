"""Membership at another size: weights of the map's own pixels, interpolated bilinearly; contours may be made crisp."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from .membership import Membership, TileMembership

_CHUNK_ELEMENTS = 1 << 21
TINY = 1e-6  # of variances, which are above 0
MARGIN = 0.25  # so that a line one pixel wide stays about that wide


class _Axis(NamedTuple):
    """Where the pixels of one axis lie between those of the map."""

    low: Tensor  # [n] int64, the neighbour before
    high: Tensor  # [n] int64, the one after, both clamped to the map
    weight: Tensor  # [n] float64, of the one after


class Resampled(Membership):
    """Membership of a soft map at another size.

    A point between the centres of four pixels has u_r, the bilinear mean of their memberships; beyond the outermost
    centres those of the border are held. In a larger image that is too soft: where v is the variance of the blur, which
    the image's own pixels have part in, v - 1/12 is that of the contour alone, and v + 1/6 is what interpolation makes
    of it. So there s_r = u_r**e / (sum of all u**e), with e**2 = (v + q / 6) / max(v - q / 12, q / 24) and
    q = 1 - old pixels / new pixels; v is interpolated as u is. At the size of the map that would be the map itself.
    """

    def __init__(self, index: Tensor, source: Membership) -> None:
        """Take labels at the new size, (B, H, W), and the map at its own."""
        super().__init__(index, source.num_regions, source.softness)
        self.source = source
        self.ratio = index.shape[1] * index.shape[2] / (source.index.shape[1] * source.index.shape[2])

    def to(self, device: torch.device) -> Resampled:
        """Return the same membership on `device`, tables not carried along."""
        return Resampled(self.index.to(device), self.source.to(device))

    def weights(self, batch: int, region: int, dtype: torch.dtype) -> Tensor:
        """Evaluate s_r of one region over one whole map, (H, W): the definition, without tables."""
        mean = self._interpolated(batch, region)
        if self._exponents() is None:
            return mean.to(dtype)
        exponent, most, total = self.derived(("sums", batch), lambda _: self._sums(batch))
        return ((mean / most) ** exponent / total).to(dtype)

    def _sums(self, batch: int) -> tuple[float | Tensor, Tensor, Tensor]:
        """Return the exponents of a map, the largest u, and the sum of powers of what they are to it."""
        exponent = self._exponents()
        assert exponent is not None
        if isinstance(exponent, Tensor):
            down, across = self._matrices(exponent.shape[1:])
            exponent = sharpness(down @ exponent[batch] @ across.T, self._lost)
        regions = range(self.num_regions)
        most = functools.reduce(torch.maximum, (self._interpolated(batch, r) for r in regions))
        powers = ((self._interpolated(batch, r) / most) ** exponent for r in regions)
        return exponent, most, functools.reduce(torch.add, powers)

    def _interpolated(self, batch: int, region: int) -> Tensor:
        weights = self._own_weights(batch, region)
        down, across = self._matrices(weights.shape)
        return down @ weights @ across.T

    def _own_weights(self, batch: int, region: int) -> Tensor:
        """Evaluate what is interpolated, at the map's own size."""
        return self.source.weights(batch, region, torch.float64)

    @property
    def _lost(self) -> float:
        return max(0.0, 1.0 - 1.0 / self.ratio)

    def _exponents(self) -> float | Tensor | None:
        """Return the exponent, or, where pixels of the map have several, their variances; None: u are the weights."""
        widths, level = self.source.levels
        if self._lost == 0.0:
            return None
        if level is not None:
            return self.source.variances
        return float(sharpness(torch.tensor(widths[0] ** 2, dtype=torch.float64), self._lost))

    def _matrices(self, shape: Sequence[int]) -> Iterator[Tensor]:
        """Make the interpolation of whole columns and rows."""
        first = torch.zeros(1, dtype=torch.int64, device=self.index.device)
        return (_matrix(axis, first, n)[0] for axis, n in zip(self._axes(1), shape, strict=True))

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
        numbers = torch.arange(len(batch), device=batch.device)
        single, keys = source.list_keys(numbers, (batch, *corners), spans, source.radius)
        tiles, region = keys // self.num_regions, keys % self.num_regions
        groups = tiles.unique(return_inverse=True)[1]
        masks = torch.zeros(len(keys), tile * tile, dtype=torch.float64, device=keys.device)
        # regions of a tile stay in one chunk where they are weighed against each other
        most = max(1, _CHUNK_ELEMENTS // (spans[0] * spans[1] + tile * tile))
        alone = torch.arange(len(keys), device=keys.device).split(most)
        for chunk in alone if self._exponents() is None else _chunks(groups, most):
            t, y, x = tiles[chunk], row[tiles[chunk]], col[tiles[chunk]]
            begins = batch[t], firsts[0][y], firsts[1][x]
            mean = down[y] @ self._windows(begins, region[chunk], groups[chunk], spans) @ across[x].mT
            exponent = self._exponents()
            if isinstance(exponent, Tensor):
                exponent = sharpness(down[y] @ source.read(exponent, begins, spans) @ across[x].mT, self._lost)
            masks[chunk] = (mean if exponent is None else _sharpen(mean, groups[chunk], exponent)).flatten(1)
        seen = (masks > 0).any(1)
        return TileMembership.assemble(single, keys[seen], masks[seen])

    def _windows(self, place: tuple[Tensor, ...], region: Tensor, group: Tensor, spans: Sequence[int]) -> Tensor:
        """Evaluate the weights of the map's own pixels over windows, (P, *spans); those of a group cover one place."""
        batch, rows, cols = place
        return self.source.window_weights(batch, region, rows, cols, spans)


class Crisp(Resampled):
    """Membership of contours that are about one pixel wide at any size: a smooth curve between the map's pixels.

    Labels are blurred by the width of one label; where that takes the largest share at the centre of a pixel from its
    own label, it is given back, with `MARGIN` more than any other. Interpolated bilinearly to weights u_r, that makes
    the weights s_r = u_r**e / (sum of all u**e): along a straight contour, a step of 1/2 pixel's deviation with
    e = 2 sqrt(new pixels / old pixels), 1 at least.
    """

    def __init__(self, index: Tensor, labels: Membership) -> None:
        """Take labels at the new size, (B, H, W), and the map at its own, whatever its widths."""
        super().__init__(index, labels.derived("smooth", _smooth))

    def _exponents(self) -> float:
        return max(1.0, 2.0 * math.sqrt(self.ratio))

    def _own_weights(self, batch: int, region: int) -> Tensor:
        best = self.derived(("best", batch), lambda _: self._best(batch))
        return _keep(super()._own_weights(batch, region), best, self.source.index[batch] == region)

    def _best(self, batch: int) -> Tensor:
        weights = (self.source.weights(batch, r, torch.float64) for r in range(self.num_regions))
        return functools.reduce(torch.maximum, weights)

    def _windows(self, place: tuple[Tensor, ...], region: Tensor, group: Tensor, spans: Sequence[int]) -> Tensor:
        weights = super()._windows(place, region, group, spans)
        seen = self.source.read(self.source.index, place, spans)
        best = _most(weights, group)
        return _keep(weights, best, seen == region[:, None, None])

    def to(self, device: torch.device) -> Crisp:
        """Return the same membership on `device`, tables not carried along."""
        return Crisp(self.index.to(device), self.source.to(device))


def _smooth(labels: Membership) -> Membership:
    return Membership(labels.index, labels.num_regions, 1.0)


def _keep(weights: Tensor, best: Tensor, own: Tensor) -> Tensor:
    return torch.where(own & (weights < best), best + MARGIN, weights)


def sharpness(variance: Tensor, lost: float | Tensor) -> Tensor:
    """Evaluate the exponent of :class:`Resampled` for variances; `lost` is its q."""
    variance, least = variance.clamp_min(TINY), torch.as_tensor(lost).to(variance) / 24
    return ((variance + lost / 6) / torch.maximum(variance - lost / 12, least)).sqrt()


def _sharpen(weights: Tensor, group: Tensor, exponent: float | Tensor) -> Tensor:
    """Raise the weights of each group, (P, n, n), to a power, and let them sum to one."""
    powers = (weights / _most(weights, group)) ** exponent
    first = int(group[0])
    total = torch.zeros(int(group[-1]) - first + 1, *weights.shape[1:], dtype=weights.dtype, device=weights.device)
    return powers / total.index_add_(0, group - first, powers)[group - first]


def _most(weights: Tensor, group: Tensor) -> Tensor:
    """Find the largest weights of each group, whose numbers ascend, for each of its rows."""
    place = group - group[0]
    most = weights.new_zeros(int(place[-1]) + 1, *weights.shape[1:])
    most.scatter_reduce_(0, place.view(-1, 1, 1).expand_as(weights), weights, "amax")
    return most[place]


def _chunks(groups: Tensor, most: int) -> Iterator[Tensor]:
    """Cut rows, by ascending group, into chunks of whole groups of about `most` rows."""
    numbers = torch.arange(len(groups), device=groups.device)
    if len(groups) == 0:
        return
    begins = (groups.diff(prepend=groups[:1] - 1) > 0).nonzero().flatten().tolist()
    start = 0
    for begin, end in zip(begins, [*begins[1:], len(groups)], strict=True):
        if end - start > most and begin > start:
            yield numbers[start:begin]
            start = begin
    yield numbers[start:]


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
