"""Membership of a map at another size: interpolated bilinearly, with contours as soft as the map's, or crisp."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from .membership import Membership, TileMembership

# pixels of windows and tiles that are evaluated at once: 16 MiB in float64
_CHUNK_PIXELS = 1 << 21
# least variance of a contour, in square pixels: exponents stay finite
TINY = 1e-6
# by which a crisp pixel's own label has a larger share than others: a line one pixel wide stays about that wide
MARGIN = 0.25


class _Axis(NamedTuple):
    """Position of the new pixels along one axis between pixels of the map."""

    low: Tensor  # [n] int64, the pixel before, clamped to the map
    high: Tensor  # [n] int64, the pixel after, clamped to the map
    weight: Tensor  # [n] float64, of the pixel after


class Resampled(Membership):
    """Membership of a soft map at another size.

    A point between the centres of four pixels has u_r, the bilinear mean of their memberships; beyond the outermost
    centres the border repeats. In a larger image that is too soft: 1/12 of v, the variance of the blur, comes from the
    map's pixels, v - 1/12 from the contour alone, and interpolation makes it v + 1/6. So s_r = u_r**e / (sum of all
    u**e), with e**2 = (v + q / 6) / max(v - q / 12, q / 24) and q = 1 - old pixels / new pixels; v is interpolated as u
    is. At the map's own size q = 0 and e = 1, which leaves the map as it is.
    """

    def __init__(self, index: Tensor, source: Membership) -> None:
        """Take labels at the new size, (B, H, W), and the map at its own."""
        super().__init__(index, source.num_regions, source.softness)
        self.source = source
        self.ratio = index.shape[1] * index.shape[2] / (source.index.shape[1] * source.index.shape[2])

    def to(self, device: torch.device) -> Resampled:
        """Return the same membership on `device`, without tables."""
        return Resampled(self.index.to(device), self.source.to(device))

    def weights(self, batch: int, region: int, dtype: torch.dtype) -> Tensor:
        """Evaluate s_r of one region over one whole map, (H, W): the definition, without tables."""
        mean = self._interpolated(batch, region)
        if self._exponents() is None:
            return mean.to(dtype)
        exponent, largest, total = self.derived(("sums", batch), lambda _: self._sums(batch))
        return ((mean / largest) ** exponent / total).to(dtype)

    def _sums(self, batch: int) -> tuple[float | Tensor, Tensor, Tensor]:
        """Return the exponents e of a map, the largest u of each pixel, and the sum of all (u / largest)**e."""
        exponent = self._exponents()
        assert exponent is not None
        if isinstance(exponent, Tensor):
            down, across = self._matrices(exponent.shape[1:])
            exponent = sharpness(down @ exponent[batch] @ across.T, self._enlargement)
        regions = range(self.num_regions)
        largest = functools.reduce(torch.maximum, (self._interpolated(batch, r) for r in regions))
        powers = ((self._interpolated(batch, r) / largest) ** exponent for r in regions)
        return exponent, largest, functools.reduce(torch.add, powers)

    def _interpolated(self, batch: int, region: int) -> Tensor:
        weights = self._source_weights(batch, region)
        down, across = self._matrices(weights.shape)
        return down @ weights @ across.T

    def _source_weights(self, batch: int, region: int) -> Tensor:
        """Evaluate the weights that are interpolated, at the map's own size."""
        return self.source.weights(batch, region, torch.float64)

    @property
    def _enlargement(self) -> float:
        """The q of the class."""
        return max(0.0, 1.0 - 1.0 / self.ratio)

    def _exponents(self) -> float | Tensor | None:
        """Return the exponent e, or, where contours have several widths, the variances of pixels; None: e is 1."""
        widths, level = self.source.levels
        if self._enlargement == 0.0:
            return None
        if level is not None:
            return self.source.variances
        return float(sharpness(torch.tensor(widths[0] ** 2, dtype=torch.float64), self._enlargement))

    def _matrices(self, shape: Sequence[int]) -> Iterator[Tensor]:
        """Yield the matrices that interpolate columns and rows of a map of this shape."""
        first = torch.zeros(1, dtype=torch.int64, device=self.index.device)
        return (_matrix(axis, first, n)[0] for axis, n in zip(self._axes(1), shape, strict=True))

    def _axes(self, tile: int) -> tuple[_Axis, _Axis]:
        """Return the axes of rows and columns, padded to whole tiles with their last pixel."""
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
        corners = torch.stack([batch, firsts[0][row], firsts[1][col]], 1)
        single, keys = self.source.list_keys(corners, spans, torch.full_like(row, self.source.radius))
        tiles, region = keys // self.num_regions, keys % self.num_regions
        groups = tiles.unique(return_inverse=True)[1]
        masks = torch.zeros(len(keys), tile * tile, dtype=torch.float64, device=keys.device)
        length = max(1, _CHUNK_PIXELS // (spans[0] * spans[1] + tile * tile))
        equal_chunks = torch.arange(len(keys), device=keys.device).split(length)
        # exponents need all regions of a tile in one chunk
        for chunk in equal_chunks if self._exponents() is None else _chunks(groups, length):
            t, y, x = tiles[chunk], row[tiles[chunk]], col[tiles[chunk]]
            mean = down[y] @ self._windows(corners[t], region[chunk], groups[chunk], spans) @ across[x].mT
            exponent = self._exponents()
            if isinstance(exponent, Tensor):
                exponent = sharpness(
                    down[y] @ self.source.read(exponent, corners[t], spans) @ across[x].mT, self._enlargement
                )
            masks[chunk] = (mean if exponent is None else _sharpen(mean, groups[chunk], exponent)).flatten(1)
        is_present = (masks > 0).any(1)
        return TileMembership.assemble(single, keys[is_present], masks[is_present])

    def _windows(self, place: Tensor, region: Tensor, group: Tensor, spans: Sequence[int]) -> Tensor:
        """Evaluate the weights of the map's own pixels over windows, (P, *spans), at the same place within a group."""
        return self.source.window_weights(place, region, spans)


class Crisp(Resampled):
    """Membership of contours that are about one pixel wide at any size: a smooth curve between the map's pixels.

    Labels are blurred with a width of one pixel. Where another label then has a larger share of a pixel than its own,
    its own is set to that share plus `MARGIN`. Interpolated bilinearly, the weights u_r give
    s_r = u_r**e / (sum of all u**e) with e = 2 sqrt(new pixels / old pixels), 1 at least: across a straight contour, a
    step with a standard deviation of half a pixel.
    """

    def __init__(self, index: Tensor, labels: Membership) -> None:
        """Take labels at the new size, (B, H, W), and the map at its own, whatever its widths."""
        super().__init__(index, labels.derived("smooth", _smooth))

    def _exponents(self) -> float:
        return max(1.0, 2.0 * math.sqrt(self.ratio))

    def _source_weights(self, batch: int, region: int) -> Tensor:
        largest = self.derived(("largest", batch), lambda _: self._largest(batch))
        return _restore(super()._source_weights(batch, region), largest, self.source.index[batch] == region)

    def _largest(self, batch: int) -> Tensor:
        weights = (self.source.weights(batch, r, torch.float64) for r in range(self.num_regions))
        return functools.reduce(torch.maximum, weights)

    def _windows(self, place: Tensor, region: Tensor, group: Tensor, spans: Sequence[int]) -> Tensor:
        weights = super()._windows(place, region, group, spans)
        labels = self.source.read(self.source.index, place, spans)
        return _restore(weights, _group_max(weights, group), labels == region[:, None, None])

    def to(self, device: torch.device) -> Crisp:
        """Return the same membership on `device`, without tables."""
        return Crisp(self.index.to(device), self.source.to(device))


def _smooth(labels: Membership) -> Membership:
    return Membership(labels.index, labels.num_regions, 1.0)


def _restore(weights: Tensor, largest: Tensor, inside: Tensor) -> Tensor:
    """Give pixels inside a region their largest weight there."""
    return torch.where(inside & (weights < largest), largest + MARGIN, weights)


def sharpness(variance: Tensor, enlargement: float | Tensor) -> Tensor:
    """Evaluate the exponent e of :class:`Resampled` for variances; `enlargement` is its q."""
    variance, least = variance.clamp_min(TINY), torch.as_tensor(enlargement).to(variance) / 24
    return ((variance + enlargement / 6) / torch.maximum(variance - enlargement / 12, least)).sqrt()


def _sharpen(weights: Tensor, group: Tensor, exponent: float | Tensor) -> Tensor:
    """Raise the weights of each group, (P, n, n), to a power, and let them sum to one."""
    powers = (weights / _group_max(weights, group)) ** exponent
    first = int(group[0])
    total = torch.zeros(int(group[-1]) - first + 1, *weights.shape[1:], dtype=weights.dtype, device=weights.device)
    return powers / total.index_add_(0, group - first, powers)[group - first]


def _group_max(weights: Tensor, group: Tensor) -> Tensor:
    """Return, for each row, the largest weights of its group; numbers of groups ascend."""
    position = group - group[0]
    largest = weights.new_zeros(int(position[-1]) + 1, *weights.shape[1:])
    largest.scatter_reduce_(0, position.view(-1, 1, 1).expand_as(weights), weights, "amax")
    return largest[position]


def _chunks(groups: Tensor, length: int) -> Iterator[Tensor]:
    """Split rows, by ascending group, into chunks of whole groups, of about `length` rows."""
    numbers = torch.arange(len(groups), device=groups.device)
    if len(groups) == 0:
        return
    begins = (groups.diff(prepend=groups[:1] - 1) > 0).nonzero().flatten().tolist()
    start = 0
    for begin, end in zip(begins, [*begins[1:], len(groups)], strict=True):
        if end - start > length and begin > start:
            yield numbers[start:begin]
            start = begin
    yield numbers[start:]


def _axis(new: int, old: int, tile: int, device: torch.device) -> _Axis:
    position = (torch.arange(new, device=device, dtype=torch.float64) + 0.5) * (old / new) - 0.5
    position = torch.nn.functional.pad(position, (0, -new % tile), value=float(position[-1]))
    low = position.floor()
    return _Axis(low.long().clamp(0, old - 1), (low.long() + 1).clamp(0, old - 1), position - low)


def _matrix(axis: _Axis, first: Tensor, span: int) -> Tensor:
    """Return the matrix from the pixels of a window to the new ones between them, (tiles, n, span)."""
    pixel = torch.arange(span, device=first.device) + first.view(-1, 1, 1)
    low, high = (side.reshape(len(first), -1, 1) == pixel for side in axis[:2])
    weight = axis.weight.reshape(len(first), -1, 1)
    return low * (1 - weight) + high * weight
