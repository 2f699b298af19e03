"""Membership of a map at another size: its contours are smooth, and as soft as the map's and a new pixel together."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcgs._arithmetic import Numbers

from .antialiasing import SmoothLabels, antialias
from .labels import sample_labels
from .membership import Membership
from .table import MapTable
from .tile import TILE
from .tiles import to_array, with_smooth_tiles
from .widths import blurs_of

# windows per task
_TASK_WINDOWS = 32
# pixels of windows and tiles that are evaluated at once: 16 MiB in float64
_CHUNK_PIXELS = 1 << 21
# least blur of antialiased labels, in pixels of the map
LEAST_BLUR = 0.7
# variance that the finite width of a pixel adds: a standard deviation of half a pixel
PIXEL_VARIANCE = 1 / 4


class SmoothMembership(Membership):
    """Membership of antialiased labels, on the CPU; `Resampled` interpolates it between the pixels of a map.

    Labels are blurred by the softness of contours, at least by `LEAST_BLUR`. Weights do not sum to one.
    """

    margin = 1

    def __init__(self, source: Membership) -> None:
        """Take the map at its own size."""
        table = source.table.without_tiles().apply(Tensor.cpu)
        blurs = blurs_of([max(width, LEAST_BLUR) for width in source.widths], torch.device("cpu"))
        super().__init__(table._replace(blurs=blurs))
        self.source = source

    @functools.cached_property
    def smooth_labels(self) -> SmoothLabels:
        """The antialiased labels."""
        return antialias(self.index, (self.source.variances < LEAST_BLUR**2).cpu())

    @functools.cached_property
    def tiled_table(self) -> MapTable:
        """The table with the tiles of the antialiased labels."""
        return with_smooth_tiles(self.table, self.smooth_labels)

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

    u_r at a point is the bilinear mean of the weights of the four pixels around it in :class:`SmoothMembership`; beyond
    the outermost centres the border repeats. The membership is s_r = u_r**e / (sum of all u**e). The exponent is
    e**2 = (max(v, LEAST_BLUR**2) + 1/4) s / (max(v - 1/4, 0) s + 1/4), where v is the squared softness of contours,
    interpolated as u is, and s the number of new pixels per pixel of the map. So the variance of a contour is that of
    the fitted contour, less 1/4 for a pixel of the map, enlarged, plus 1/4 for a pixel of the new size.
    """

    def __init__(self, smooth: SmoothMembership, size: tuple[int, int]) -> None:
        """Take the membership that is interpolated, and a size."""
        source, table = smooth.source, smooth.source.table
        index = sample_labels(source.index, *size)
        labels = sample_labels(table.labels.view(table.shape), *size)
        super().__init__(MapTable(labels, ids=table.ids, positions=index))
        self.source, self.smooth = source, smooth
        self.ratio = math.prod(size) / math.prod(table.size)

    @functools.cached_property
    def tiled_table(self) -> MapTable:
        """The table at this size, made on the CPU."""
        return self.table.replace_tiles(part.to(self.index.device) for part in self._make_tiles())

    def weights(self, batch: int, region: int, dtype: torch.dtype) -> Tensor:
        """Evaluate s_r of one region over one whole map, (H, W): the definition, without tables."""
        exponent, largest, total = self._sums[batch]
        return ((self._interpolated(batch, region) / largest) ** exponent / total).to(self.index.device, dtype)

    @functools.cached_property
    def _sums(self) -> list[tuple[Tensor, Tensor, Tensor]]:
        """The exponents e of each map, the largest u of each pixel, and the sum of all (u / largest)**e."""
        sums = []
        for batch in range(len(self.index)):
            exponent = sharpness(self._interpolate(self.source.variances[batch].cpu()), self.ratio)
            regions = range(self.table.num_regions)
            largest = functools.reduce(torch.maximum, (self._interpolated(batch, r) for r in regions))
            powers = ((self._interpolated(batch, r) / largest) ** exponent for r in regions)
            sums.append((exponent, largest, functools.reduce(torch.add, powers)))
        return sums

    def _interpolated(self, batch: int, region: int) -> Tensor:
        return self._interpolate(self.smooth.weights(batch, region, torch.float64))

    def _interpolate(self, pixels: Tensor) -> Tensor:
        first = torch.zeros(1, dtype=torch.int64)
        down, across = (_matrix(axis, first, n)[0] for axis, n in zip(self._axes(1), pixels.shape, strict=True))
        return down @ pixels @ across.T

    def _axes(self, tile: int) -> list[_Axis]:
        """Return the axes of rows and columns, padded to whole tiles with their last pixel."""
        sizes = zip(self.table.size, self.source.table.size, strict=True)
        return [_axis(new, old, tile) for new, old in sizes]

    def _make_tiles(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        axes = self._axes(TILE)
        firsts = [axis.low[::TILE] for axis in axes]
        spans = [int((axis.high[TILE - 1 :: TILE] - first).max()) + 1 for axis, first in zip(axes, firsts, strict=True)]
        down, across = (
            _matrix(_Axis(*(part.view(-1, TILE) for part in axis)), first, span)
            for axis, first, span in zip(axes, firsts, spans, strict=True)
        )  # [tiles of the axis, 16, span] each
        counts = (len(self.index), *map(len, firsts))
        batch, row, col = torch.cartesian_prod(*map(torch.arange, counts)).unbind(1)
        corners = torch.stack([batch, firsts[0][row], firsts[1][col]], 1)
        tile, region = find_windows(self.smooth.tiled_table, corners, spans)
        is_shared = torch.bincount(tile)[tile] > 1
        shared = is_shared.nonzero().flatten()
        planes = torch.zeros(len(shared), TILE * TILE, dtype=torch.float64)
        length = max(1, _CHUNK_PIXELS // (math.prod(spans) + TILE * TILE))
        variances = self.source.variances.cpu()
        for chunk in _chunks(tile[shared], length):  # all regions of a tile are in one chunk
            pairs = shared[chunk]
            t, position = tile[pairs].unique_consecutive(return_inverse=True)
            y, x = down[row[t]], across[col[t]].mT
            exponent = sharpness(y @ _read(variances, corners[t], spans) @ x, self.ratio)
            windows = cut_windows(self.smooth.tiled_table, corners[t[position]], region[pairs], spans)
            planes[chunk] = _sharpen(y[position] @ windows @ x[position], position, exponent[position]).flatten(1)
        # some of a tile's regions have no weight there
        is_present = (planes > 0).any(1)
        is_listed = ~is_shared
        is_listed[shared] = is_present
        starts = torch.searchsorted(tile[is_listed], torch.arange(math.prod(counts) + 1), out_int32=True)
        rows = torch.full_like(tile, -1)
        rows[shared] = torch.where(is_present, is_present.cumsum(0) - 1, -1)
        weights = planes[is_present].float()
        return starts, region[is_listed].int(), rows[is_listed].int(), weights


def find_windows(table: MapTable, places: Tensor, span: Sequence[int]) -> tuple[Tensor, Tensor]:
    """List pairs of a window and a region, windows ascending, for windows of `span` pixels at places, (T, 3).

    Places are map, first row and first column. A window has the regions of the tiles that it touches.
    """
    from .loops import list_window_regions  # loads numba

    starts, regions = (to_array(part) for part in table.tiles[:2])
    arguments = starts, regions, table.shape, to_array(places), tuple(span), table.num_regions
    counts, entries = map(torch.from_numpy, list_window_regions(*arguments))
    return torch.repeat_interleave(counts), entries.long()


def cut_windows(table: MapTable, places: Tensor, regions: Tensor, span: Sequence[int]) -> Tensor:
    """Read s_r over windows of `span` pixels at places, (P, 3), out of tiles: (P, *span) float64.

    Windows may reach beyond the image, where s_r has no meaning.
    """
    from kcgs.compiled.tasks import ranges, run_tasks  # loads numba

    from .loops import cut_windows as cut

    windows = np.empty((len(regions), *span))
    loop = partial(cut, tuple(map(to_array, table.tiles)), table.shape, to_array(places), to_array(regions), windows)
    run_tasks(loop, ranges(len(regions), _TASK_WINDOWS))
    return torch.from_numpy(windows)


def _read(pixels: Tensor, places: Tensor, span: Sequence[int]) -> Tensor:
    """Read (maps, H, W) over windows, (P, *span); the border repeats."""
    lines = [
        (first[:, None] + torch.arange(side)).clamp(0, length - 1)
        for first, side, length in zip(places.unbind(1)[1:], span, pixels.shape[1:], strict=True)
    ]
    return pixels[places[:, :1, None], lines[0][:, :, None], lines[1][:, None, :]]


def contour_variance(variance: Numbers, ratio: float | Numbers) -> Numbers:
    """Convert the squared width of a contour from pixels of the map to pixels of the new size."""
    return (variance - PIXEL_VARIANCE).clamp_min(0) * ratio + PIXEL_VARIANCE


def sharpness(variance: Numbers, ratio: float | Numbers) -> Numbers:
    """Evaluate the exponent e of :class:`Resampled` for squared widths in pixels of the map; `ratio` is its s."""
    new_variance = contour_variance(variance, ratio)
    blurred = variance.clamp_min(LEAST_BLUR**2) + PIXEL_VARIANCE  # variance after antialiasing and interpolation
    return (blurred * ratio / new_variance).sqrt()


def _sharpen(weights: Tensor, position: Tensor, exponent: Tensor) -> Tensor:
    """Raise weights, (P, n, n), to a power, and normalise their sum over a tile; `position` is the tile of each."""
    largest = weights.new_zeros(int(position[-1]) + 1, *weights.shape[1:])
    total = torch.zeros_like(largest)
    largest.scatter_reduce_(0, position.view(-1, 1, 1).expand_as(weights), weights, "amax")
    powers = (weights / largest[position]) ** exponent
    return powers / total.index_add_(0, position, powers)[position]


def _chunks(groups: Tensor, length: int) -> Iterator[Tensor]:
    """Split rows, by ascending group, into chunks of whole groups, of about `length` rows."""
    numbers = torch.arange(len(groups))
    if len(groups) == 0:
        return
    begins = (groups.diff(prepend=groups[:1] - 1) > 0).nonzero().flatten().tolist()
    start = 0
    for begin, end in zip(begins, [*begins[1:], len(groups)], strict=True):
        if end - start > length and begin > start:
            yield numbers[start:begin]
            start = begin
    yield numbers[start:]


def _axis(new: int, old: int, tile: int) -> _Axis:
    position = (torch.arange(new, dtype=torch.float64) + 0.5) * (old / new) - 0.5
    position = torch.nn.functional.pad(position, (0, -new % tile), value=float(position[-1]))
    low = position.floor()
    return _Axis(low.long().clamp(0, old - 1), (low.long() + 1).clamp(0, old - 1), position - low)


def _matrix(axis: _Axis, first: Tensor, span: int) -> Tensor:
    """Return the matrices that interpolate new pixels from the pixels of windows, (tiles, n, span)."""
    pixel = torch.arange(span) + first.view(-1, 1, 1)
    low, high = (side.reshape(len(first), -1, 1) == pixel for side in axis[:2])
    weight = axis.weight.reshape(len(first), -1, 1)
    return low * (1 - weight) + high * weight
