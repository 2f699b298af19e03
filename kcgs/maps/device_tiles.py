"""The tiles of a `MapTable` by torch operations, on any device; `tiles.py` has the CPU's own form.

For 64 maps of 128 x 128 pixels on one CPU core they need 148 ms with hard contours and 166 ms with soft contours; the
compiled loops need 7 and 51 ms: so both forms stay. A tile lists the regions of all pixels that its own pixels are
blurred with. A window is a tile and the pixels around it. The host waits twice for the device: the lengths of two lists
depend on the map.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from .tile import TILE
from .widths import reach_of, truncated_gaussian

# bytes of windows and their intermediate results that are in memory at once
_CHUNK_BYTES = 1 << 27
# bytes per pixel of a window in a list: the label, its tests, its key
_LISTED_BYTES = 24


def tiles_on_device(
    index: Tensor, num_regions: int, widths: Sequence[float] = (0.0,), width_index: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the `TILE_FIELDS` of a `MapTable` on the device of a map.

    Args:
        index: position of each pixel's region among the sorted ids, (maps, H, W) int32.
        num_regions: number of ids.
        widths: of contours in pixels, ascending; 0 is hard.
        width_index: position of each pixel's width among them, (maps, H, W) int32; None where there is one width.
    """
    windows = _Windows(index, reach_of(widths[-1]))
    tile_widths = None if width_index is None else _TileWidths(width_index)
    reaches = None if tile_widths is None else tile_widths.reaches(widths)
    keys = _list_keys(windows, num_regions, reaches).sort()[0]
    tile = keys // num_regions
    is_first = keys.diff(prepend=keys.new_full((1,), -1)) != 0
    counts = keys.new_zeros(math.prod(windows.grid)).index_add_(0, tile, is_first.long())
    is_shared = is_first & (counts[tile] > 1)
    blurs = is_shared if tile_widths is None else is_shared * tile_widths.counts[tile]
    ends = torch.stack([is_first, is_shared, blurs]).cumsum(1)
    num_entries, num_planes, num_blurs = ends[:, -1].tolist()
    entries = _compress(keys, is_first, ends[0], num_entries)
    planes = _compress(torch.where(is_shared, ends[1] - 1, -1), is_first, ends[0], num_entries)
    shared = _compress(keys, is_shared, ends[1], num_planes)
    members = _Members(windows, shared // num_regions, shared % num_regions)
    return (
        torch.nn.functional.pad(counts.cumsum(0), (1, 0)).int(),
        (entries % num_regions).int(),
        planes.int(),
        members.blur(widths) if tile_widths is None else members.blur_by_pixel(widths, tile_widths, num_blurs),
    )


def _split(pixels: Tensor, reach: int, outside: int) -> Tensor:
    """View (maps, H, W) as the windows of tiles, (maps, rows, cols, side, side)."""
    height, width = pixels.shape[1:]
    sides = reach, -width % TILE + reach, reach, -height % TILE + reach
    padded = torch.nn.functional.pad(pixels, sides, value=outside)
    return padded.unfold(1, TILE + 2 * reach, TILE).unfold(2, TILE + 2 * reach, TILE)


class _Windows:
    """The labels around the tiles of a map, -1 outside of the image."""

    def __init__(self, index: Tensor, reach: int) -> None:
        maps, height, width = index.shape
        self.reach = reach
        self.image = height, width
        self.grid = maps, -(-height // TILE), -(-width // TILE)
        self._labels = _split(index, reach, -1)

    def labels(self, tiles: Tensor) -> Tensor:
        """Return the windows of tiles, (n, side, side)."""
        return self._labels[self.places(tiles)]

    def places(self, tiles: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return map, row and column of each tile in the grid of tiles."""
        _, rows, cols = self.grid
        return tiles // (rows * cols), tiles // cols % rows, tiles % cols

    def inside(self, axis: int) -> Tensor:
        """Return which pixels of the windows along an axis are in the image, (tiles of the axis, side)."""
        first = torch.arange(self.grid[1 + axis], device=self._labels.device)[:, None] * TILE
        pixel = first + self.offsets
        return (pixel >= 0) & (pixel < self.image[axis])

    @property
    def side(self) -> int:
        """Pixels of a window along a side."""
        return TILE + 2 * self.reach

    @property
    def offsets(self) -> Tensor:
        """Places of a window's pixels along an axis, from the tile's first pixel, (side,)."""
        return torch.arange(self.side, device=self._labels.device) - self.reach


class _TileWidths:
    """The contour widths in each tile, as positions among the widths of a map."""

    def __init__(self, width_index: Tensor) -> None:
        self.pixels = _split(width_index, 0, 0).reshape(-1, TILE * TILE)  # [tiles, 256]
        ascending = self.pixels.sort(1)[0].long()
        is_new = torch.nn.functional.pad(ascending.diff(dim=1) != 0, (1, 0), value=True)
        ranks = is_new.cumsum(1) - 1
        self.counts = ranks[:, -1] + 1  # [tiles]
        self.distinct = torch.zeros_like(ascending).scatter_(1, ranks, ascending)  # [tiles, 256], then zeros
        self._widest = ascending[:, -1]

    def reaches(self, widths: Sequence[float]) -> Tensor:
        """Return the reach of the widest blur of each tile, in pixels, (tiles,)."""
        return _on_device([reach_of(width) for width in widths], self.counts.device)[self._widest]


class _Members(NamedTuple):
    """Pairs of a tile and a region, and the windows with the labels."""

    windows: _Windows
    tiles: Tensor  # [P]
    regions: Tensor  # [P]

    def blur(self, widths: Sequence[float]) -> Tensor:
        """Return the membership of the tiles' pixels in the regions, (P, 256), blurred by one width."""
        weights = torch.empty(len(self.tiles), TILE * TILE, dtype=torch.float32, device=self.tiles.device)
        blurs = _Blurs(self.windows, widths)
        for chunk in _chunks(len(weights), blurs.bytes):
            weights[chunk] = blurs.apply(self.tiles[chunk], self.regions[chunk], torch.zeros_like(self.tiles[chunk]))
        return weights

    def blur_by_pixel(self, widths: Sequence[float], tile_widths: _TileWidths, count: int) -> Tensor:
        """Blur each pixel by its own width; `count` is the number of widths per tile, summed over the tiles."""
        weights = torch.zeros(len(self.tiles), TILE * TILE, dtype=torch.float32, device=self.tiles.device)
        blurs = _Blurs(self.windows, widths)
        counts = tile_widths.counts[self.tiles]
        plane = torch.repeat_interleave(counts, output_size=count)
        rank = torch.arange(count, device=plane.device) - (counts.cumsum(0) - counts)[plane]
        tiles, regions = self.tiles[plane], self.regions[plane]
        width = tile_widths.distinct[tiles, rank]
        for chunk in _chunks(count, blurs.bytes):
            blurred = blurs.apply(tiles[chunk], regions[chunk], width[chunk])
            is_own = tile_widths.pixels[tiles[chunk]] == width[chunk, None]
            weights.index_add_(0, plane[chunk], torch.where(is_own, blurred, 0.0))  # one term is not 0
        return weights


class _Blurs:
    """The blurs of windows by the widths of a map: along columns, then along rows."""

    def __init__(self, windows: _Windows, widths: Sequence[float]) -> None:
        self._windows = windows
        device = windows.offsets.device
        distance = (windows.offsets - torch.arange(TILE, device=device)[:, None]).abs()
        self._taps = truncated_gaussian(distance, _on_device(widths, device)[:, None, None])  # [widths, 16, side]
        # sums of the taps that lie within the image, [widths, tiles of the axis, 16]
        self._totals = [(self._taps @ windows.inside(axis).double().mT).mT for axis in (0, 1)]
        self.bytes = 8 * windows.side * (2 * windows.side + 3 * TILE)  # of one window

    def apply(self, tiles: Tensor, regions: Tensor, widths: Tensor) -> Tensor:
        """Blur the masks of regions in the windows of tiles, (n, 256)."""
        members = (self._windows.labels(tiles) == regions[:, None, None]).double()
        _, rows, cols = self._windows.places(tiles)
        down, across = (part[widths, place] for part, place in zip(self._totals, (rows, cols), strict=True))
        taps = self._taps[widths]
        total = down[:, :, None] * across[:, None, :]
        return (taps @ members @ taps.mT / total.clamp_min(1e-300)).flatten(1).float()


def _on_device(values: Sequence[float], device: torch.device) -> Tensor:
    """Copy float64 numbers to a device; the host does not wait."""
    return torch.tensor(values, dtype=torch.float64).to(device, non_blocking=True)


def _list_keys(windows: _Windows, num_regions: int, reaches: Tensor | None) -> Tensor:
    """List the keys tile * num_regions + region of the regions in each tile's window; keys may repeat.

    It takes the pixels that differ from the pixel above and the pixel to the left, as every region's first pixel does.
    """
    keys = []
    tiles, offsets = torch.arange(math.prod(windows.grid), device=windows.offsets.device), windows.offsets
    for chunk in _chunks(len(tiles), windows.side**2 * _LISTED_BYTES):
        labels = windows.labels(tiles[chunk])
        if reaches is not None:
            is_near = (offsets >= -reaches[chunk, None]) & (offsets < TILE + reaches[chunk, None])
            labels = torch.where(is_near[:, :, None] & is_near[:, None, :], labels, -1)
        above, left = (torch.nn.functional.pad(labels, sides, value=-1) for sides in ((0, 0, 1, 0), (1, 0)))
        is_new = (labels != above[:, :-1]) & (labels != left[:, :, :-1]) & (labels >= 0)
        keys.append((tiles[chunk, None, None] * num_regions + labels)[is_new])
    return torch.cat(keys)


def _compress(values: Tensor, is_chosen: Tensor, ends: Tensor, count: int) -> Tensor:
    """Return the chosen values, `count` in number; `ends` counts them up to each value."""
    target = values.new_empty(count + 1)  # the last one takes all others
    return target.scatter_(0, torch.where(is_chosen, ends - 1, count), values)[:count]


def _chunks(count: int, size: int) -> Iterator[slice]:
    """Yield parts of a range of rows with `size` bytes each."""
    length = max(1, _CHUNK_BYTES // size)
    return (slice(start, start + length) for start in range(0, count, length))
