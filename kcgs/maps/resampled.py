"""Membership of a map at another size: of smooth contours, as soft as the map's, and one pixel of the new size."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from .antialiasing import SmoothLabels, antialias
from .coverage import TILE, Coverage
from .membership import Levels, Membership, TileMembership

# pixels of windows and tiles that are evaluated at once: 16 MiB in float64
_CHUNK_PIXELS = 1 << 21
# least blur of antialiased labels, in pixels of the map
LEAST_BLUR = 0.7
# squared width of a pixel: its standard deviation is a half
PIXEL = 1 / 4


class SmoothMembership(Membership):
    """Membership of antialiased labels: what is interpolated between the pixels of a map.

    Labels are blurred by the softness of contours, but by `LEAST_BLUR` at least. Weights do not sum to one.
    """

    margin = 1

    def __init__(self, source: Membership) -> None:
        """Take the map at its own size."""
        super().__init__(source.index, source.num_regions, source.softness)
        self.source = source

    @property
    def levels(self) -> Levels:
        """Widths of the blur of pixels."""
        widths, level = self.source.levels
        return Levels(tuple(max(width, LEAST_BLUR) for width in widths), level)

    @property
    def smooth_labels(self) -> SmoothLabels:
        """The antialiased labels."""
        return self.derived("labels", lambda _: antialias(self.index, self.source.variances < LEAST_BLUR**2))

    def _inside(self, batch: int, region: int) -> Tensor:
        weight, other, other_weight = (part[batch] for part in self.smooth_labels)
        return super()._inside(batch, region) * weight + (other == region) * other_weight


class _Axis(NamedTuple):
    """Position of the new pixels along one axis between pixels of the map."""

    low: Tensor  # [n] int64, the pixel before, clamped to the map
    high: Tensor  # [n] int64, the pixel after, clamped to the map
    weight: Tensor  # [n] float64, of the pixel after


class Resampled(Membership):
    """Membership of a map at another size.

    A point between the centres of four pixels has u_r, the bilinear mean of their weights in :class:`SmoothMembership`;
    beyond the outermost centres the border repeats. Its membership is s_r = u_r**e / (sum of all u**e). With v, the
    squared softness of contours, interpolated as u is, and s, the number of new pixels per pixel of the map,
    e**2 = (max(v, LEAST_BLUR**2) + 1/4) s / (max(v - 1/4, 0) s + 1/4): the contour is as wide as the fitted one,
    without the blur of the map's pixels, and as a pixel of the new size, half of which is a standard deviation.
    """

    def __init__(self, index: Tensor, source: Membership) -> None:
        """Take labels at the new size, (B, H, W), and the map at its own."""
        super().__init__(index, source.num_regions, source.softness)
        self.original = source
        self.source = source.derived("smooth", SmoothMembership)
        self.ratio = index.shape[1] * index.shape[2] / (source.index.shape[1] * source.index.shape[2])

    def to(self, device: torch.device) -> Resampled:
        """Return the same membership on `device`, without tables."""
        return Resampled(self.index.to(device), self.original.to(device))

    def weights(self, batch: int, region: int, dtype: torch.dtype) -> Tensor:
        """Evaluate s_r of one region over one whole map, (H, W): the definition, without tables."""
        exponent, largest, total = self.derived(("sums", batch), lambda _: self._sums(batch))
        return ((self._interpolated(batch, region) / largest) ** exponent / total).to(dtype)

    def _sums(self, batch: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return the exponents e of a map, the largest u of each pixel, and the sum of all (u / largest)**e."""
        exponent = sharpness(self._interpolate(self.original.variances[batch]), self.ratio)
        regions = range(self.num_regions)
        largest = functools.reduce(torch.maximum, (self._interpolated(batch, r) for r in regions))
        powers = ((self._interpolated(batch, r) / largest) ** exponent for r in regions)
        return exponent, largest, functools.reduce(torch.add, powers)

    def _interpolated(self, batch: int, region: int) -> Tensor:
        return self._interpolate(self.source.weights(batch, region, torch.float64))

    def _interpolate(self, pixels: Tensor) -> Tensor:
        down, across = self._matrices(pixels.shape)
        return down @ pixels @ across.T

    def _matrices(self, shape: Sequence[int]) -> Iterator[Tensor]:
        """Yield the matrices that interpolate columns and rows of a map of this shape."""
        first = torch.zeros(1, dtype=torch.int64, device=self.index.device)
        return (_matrix(axis, first, n)[0] for axis, n in zip(self._axes(1), shape, strict=True))

    def _axes(self, tile: int) -> tuple[_Axis, _Axis]:
        """Return the axes of rows and columns, padded to whole tiles with their last pixel."""
        sizes = zip(self.index.shape[1:], self.source.index.shape[1:], strict=True)
        return tuple(_axis(new, old, tile, self.index.device) for new, old in sizes)  # type: ignore[return-value]

    def _build_coverage(self) -> Coverage:
        keys, rows, masks = self.tiles(TILE)
        tiles = self.index.shape[0] * math.prod(-(-side // TILE) for side in self.index.shape[1:])
        firsts = torch.arange(tiles + 1, device=keys.device) * self.num_regions
        starts = torch.searchsorted(keys, firsts, out_int32=True)
        return Coverage(starts, (keys % self.num_regions).int(), rows.int(), masks.float())

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
        variances = self.original.variances
        for chunk in _chunks(groups, length):  # all regions of a tile are in one
            t, position = tiles[chunk].unique_consecutive(return_inverse=True)
            y, x = down[row[t]], across[col[t]].mT
            exponent = sharpness(y @ self.source.read(variances, corners[t], spans) @ x, self.ratio)
            windows = self.source.window_weights(corners[t[position]], region[chunk], spans)
            masks[chunk] = _sharpen(y[position] @ windows @ x[position], position, exponent[position]).flatten(1)
        is_present = (masks > 0).any(1)
        return TileMembership.assemble(single, keys[is_present], masks[is_present])


def contour_variance(variance: Tensor, ratio: float | Tensor) -> Tensor:
    """Return the squared width, in pixels of the new size, for that in pixels of the map."""
    return (variance - PIXEL).clamp_min(0) * ratio + PIXEL


def sharpness(variance: Tensor, ratio: float | Tensor) -> Tensor:
    """Evaluate the exponent e of :class:`Resampled` for squared widths in pixels of the map; `ratio` is its s."""
    blurred = variance.clamp_min(LEAST_BLUR**2) + PIXEL  # what antialiasing and interpolation add
    return (blurred * ratio / contour_variance(variance, ratio)).sqrt()


def _sharpen(weights: Tensor, position: Tensor, exponent: Tensor) -> Tensor:
    """Raise the weights of each tile, (P, n, n), to a power, and let them sum to one; `position` counts the tiles."""
    largest = weights.new_zeros(int(position[-1]) + 1, *weights.shape[1:])
    total = torch.zeros_like(largest)
    largest.scatter_reduce_(0, position.view(-1, 1, 1).expand_as(weights), weights, "amax")
    powers = (weights / largest[position]) ** exponent
    return powers / total.index_add_(0, position, powers)[position]


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
