"""Membership of one tile at a time from labels and softness alone: `kcgs.maps.membership` in standard operators.

Nothing is cached beside a map and no shape depends on values, so that a graph can hold it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kcgs.maps import LEAST_BLUR, RADIUS_SIGMAS, MapOperands, antialias, sharpness, shifted

from .sizes import is_equal

_FAR = 1e12  # more than any squared distance
_TINY = 1e-30  # less than any sum of a blur
_LARGEST_EXPONENT = 64  # of memberships: float32 holds the powers


class MapWindows:
    """A map at the size of an image, by tiles.

    `tables` is computed once. Loops of a graph are handed all tensors that they read, and hand it to `read_tile`.
    """

    def __init__(self, regions: MapOperands, side: int, dtype: torch.dtype) -> None:
        """Prepare tiles of `side` pixels; memberships are computed in `dtype`."""
        labels, softness, size = regions
        device = labels.device
        self.side, self.dtype = side, dtype
        self.is_resized = not all(is_equal(new, old) for new, old in zip(size, labels.shape[-2:], strict=True))
        self.soft = softness is not None or self.is_resized
        self.pairs = softness is not None and softness.ndim == 2
        taps = 1 if softness is None else softness.shape[-1] - (3 if self.pairs else 1)
        least = math.ceil(RADIUS_SIGMAS * LEAST_BLUR) if self.is_resized else 0
        self.reach = max(taps - 1, least)
        # distance at which a region around a pixel may be a part of it: antialiasing reaches one pixel farther
        self.margin = self.reach + self.is_resized
        # the nearest contour of a pixel of several regions is no farther away than this
        self.search = math.ceil(math.sqrt(2) * self.margin)
        self.halo = self.search if self.pairs else self.margin
        down, across = (self._axis(size[k], labels.shape[k - 2], device) for k in (0, 1))
        self._tables_per_axis = len(down)
        maps = labels if labels.ndim == 3 else labels[None]
        numbers = torch.stack([torch.full((), n, dtype=torch.int64, device=device) for n in maps.shape])
        images, self._widths = self._soft_tables(maps, softness, size) if self.soft else ((), ())
        self.tables = (numbers, *down, *across, *(image.flatten() for image in (maps, *images)), *self._widths)

    def _soft_tables(
        self, maps: Tensor, softness: Tensor | None, size: Sequence[int]
    ) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        """Return what is read of pixels beside their labels; and widths of contours, their blurs, and the ratio."""
        widths = torch.zeros(1, dtype=torch.float64, device=maps.device) if softness is None else softness[:1]
        levels = torch.zeros_like(maps)
        if softness is not None and self.pairs:
            # a contour between regions that `softness` does not name is hard: one row beyond the last
            widths = torch.nn.functional.pad(softness[:, 2], (0, 1))
            levels = _touching_levels(maps, softness[:, :2].long())
        images: tuple[Tensor, ...] = (levels,) if self.pairs else ()
        blurs = widths
        sides = [torch.full((), n, dtype=torch.float64, device=maps.device) for n in (*maps.shape[-2:], *size)]
        ratio = torch.stack([sides[2] / sides[0], sides[3] / sides[1]])
        if self.is_resized:
            is_native = (ratio == 1).all()  # which a graph of any size may be
            is_sharp = widths.index_select(0, levels.clamp_min(0).flatten()).reshape(levels.shape) < LEAST_BLUR
            weight, other, other_weight = antialias(maps, is_sharp)
            blurs = torch.where(is_native, widths, widths.clamp_min(LEAST_BLUR))
            weight, other_weight = torch.where(is_native, 1.0, weight), torch.where(is_native, 0.0, other_weight)
            images = (*images, weight.to(self.dtype), other, other_weight.to(self.dtype))
        distance = torch.arange(self.reach + 1, device=maps.device)
        taps = torch.exp(-0.5 * (distance / blurs.clamp_min(1e-9)[:, None]) ** 2)
        taps = torch.where(distance <= (RADIUS_SIGMAS * blurs[:, None]).ceil(), taps, 0.0)
        return images, (widths.square(), taps, ratio)

    def _axis(self, new: int, length: int, device: torch.device) -> tuple[Tensor, ...]:
        """Return the lines of the windows of tiles, and a matrix of interpolation for each where resized."""
        count = (new + self.side - 1) // self.side
        if not self.is_resized:
            return self._lines(torch.arange(count, device=device) * self.side, self.side, length)
        # the last pixel is repeated past the edge
        pixels = torch.arange(count * self.side, device=device).clamp_max(new - 1)
        # between which pixels of the map each pixel lies, and how far
        place = ((2 * pixels + 1).double() * length - new) / (2 * new)
        low = place.floor().reshape(count, -1, 1)
        weight = (place.reshape(count, -1, 1) - low).to(self.dtype)
        first = low[:, 0, 0].long().clamp(0, length - 1)
        span = (self.side * length + new - 1) // new + 2
        window = (first[:, None] + torch.arange(span, device=device))[:, None]
        before, after = ((end.long().clamp(0, length - 1) == window).to(self.dtype) for end in (low, low + 1))
        return (*self._lines(first, span, length), before * (1 - weight) + after * weight)

    def _lines(self, first: Tensor, span: int, length: int) -> tuple[Tensor, Tensor]:
        """Return the rows or columns of windows of `span` pixels with a halo, clamped, and which are in the image."""
        lines = torch.arange(span + 2 * self.halo, device=first.device) - self.halo
        lines = first[:, None] + lines
        return lines.clamp(0, length - 1), ((lines >= 0) & (lines < length)).to(self.dtype)

    # Inside a loop, which hands in the tables

    def read_tile(self, tables: Sequence[Tensor], image: Tensor, row: Tensor, column: Tensor) -> tuple[Tensor, ...]:
        """Read the window of tile (row, column) of an image: its labels, sorted, and what `membership` takes."""
        maps, height, width = tables[0].unbind()
        first_row = image % maps * height
        end = 1 + 2 * self._tables_per_axis
        down, across = (
            [table.index_select(0, place.reshape(1)).squeeze(0) for table in part]
            for place, part in (
                (row, tables[1 : 1 + self._tables_per_axis]),
                (column, tables[1 + self._tables_per_axis : end]),
            )
        )
        places = (first_row + down[0])[:, None] * width + across[0]
        window, *images = (
            table.index_select(0, places.flatten()).reshape(places.shape)
            for table in tables[end : len(tables) - len(self._widths)]
        )
        # pixels beyond the reach of a blur say which contour is near, but are of no region here
        ids = self._crop(window, self.halo - self.margin).flatten().sort()[0]
        if not self.soft:
            return ids, window
        variances, taps, ratio = tables[-len(self._widths) :]
        level = torch.zeros_like(ids[:1])
        if self.pairs:
            # where there is one region, any blur is right
            level = torch.ops.higher_order.cond(
                ids[0] != ids[-1],
                lambda *operands: self._nearest_levels(*operands),
                lambda *operands: self._no_levels(*operands),
                (images.pop(0), down[1], across[1]),
            )[0]
        mirrored = torch.arange(-self.reach, self.reach + 1, device=window.device).abs()
        blurs = taps.to(self.dtype).index_select(0, level).index_select(1, mirrored)
        operands = (window, down[1], across[1], blurs)
        if not self.is_resized:
            return ids, *operands
        sides = [n - 2 * self.halo for n in window.shape]
        variance = variances.to(self.dtype).index_select(0, level).expand(sides[0] * sides[1]).reshape(sides)
        exponent = sharpness(down[2] @ variance @ across[2].T, ratio.prod().to(self.dtype))
        exponent = torch.where((ratio == 1).all(), 1.0, exponent.clamp_max(_LARGEST_EXPONENT))
        return ids, *operands, *images, down[2], across[2], exponent

    def membership(self, operands: Sequence[Tensor], region: Tensor) -> Tensor:
        """Evaluate the membership of a tile's pixels in a region, (1,); `operands` are what `read_tile` found.

        Of a map at another size they are to be divided by their sum over the regions.
        """
        window, *soft = operands
        inside = (window == region).to(self.dtype)
        if not soft:
            return inside
        rows_inside, columns_inside, blurs, *interpolation = soft
        if interpolation:
            weight, other, other_weight, rows, columns, exponent = interpolation
            inside = inside * weight + (other == region).to(self.dtype) * other_weight
        margin = self.halo - self.reach
        down, across = (t[margin : t.shape[0] - margin] for t in (rows_inside, columns_inside))
        membership = self._blur(self._crop(inside, margin) * down[:, None] * across, blurs, down, across)
        return (rows @ membership @ columns.T).clamp_min(0) ** exponent if interpolation else membership

    def _crop(self, window: Tensor, margin: int) -> Tensor:
        return window[margin : window.shape[0] - margin, margin : window.shape[1] - margin]

    def _blur(self, inside: Tensor, blurs: Tensor, rows_inside: Tensor, columns_inside: Tensor) -> Tensor:
        """Blur a window by one kernel, (1, 2 R + 1), or by one for each pixel inside of its halo of R."""
        taps = 2 * self.reach + 1
        height, width = (n - taps + 1 for n in inside.shape)
        steps = torch.arange(taps, device=inside.device)
        rows, columns = ((torch.arange(n, device=inside.device)[:, None] + steps).flatten() for n in (height, width))
        kernels = blurs.expand(height * width, taps).reshape(height, width, taps)
        near_rows = rows_inside.index_select(0, rows).reshape(height, 1, taps)
        near_columns = columns_inside.index_select(0, columns).reshape(width, taps)
        total = (kernels * near_rows).sum(-1) * (kernels * near_columns).sum(-1)
        # along rows, those of the halo too; then along columns
        blurred = inside.T.index_select(0, columns).reshape(width, taps, -1)
        blurred = kernels.permute(1, 0, 2) @ blurred  # [width, height, height + 2 R]
        blurred = blurred.gather(2, rows.reshape(1, height, taps).expand(width, height, taps))
        return (blurred * kernels.permute(1, 0, 2)).sum(-1).T / total.clamp_min(_TINY)

    def _no_levels(self, levels: Tensor, *_: Tensor) -> tuple[Tensor]:
        return (torch.zeros_like(self._crop(levels, self.halo).flatten()),)

    def _nearest_levels(self, levels: Tensor, rows_inside: Tensor, columns_inside: Tensor) -> tuple[Tensor]:
        """Return for each pixel inside of the halo the level of its nearest contour."""
        touches = (levels >= 0) & (rows_inside[:, None] * columns_inside > 0)
        return (self._nearest(touches, levels).flatten().clamp_min(0),)

    def _nearest(self, touches: Tensor, level: Tensor) -> Tensor:
        """Give each pixel inside of a halo of `search` the level of the nearest that touches a contour.

        Of several the leftmost, then the topmost, as scipy's distance transform has it.
        """
        taps = 2 * self.search + 1
        height, width = (n - taps + 1 for n in touches.shape)
        steps = torch.arange(taps, device=touches.device)
        squares = ((steps - self.search) ** 2).to(self.dtype)
        rows, columns = (torch.arange(n, device=touches.device)[:, None] + steps for n in (height, width))
        near = touches.index_select(0, rows.flatten()).reshape(height, taps, -1)
        square, step = torch.where(near, squares[:, None], _FAR).min(1)
        level = level.gather(0, step + rows[:, :1])  # [height, width + halo]
        square = square.T.index_select(0, columns.flatten()).reshape(width, taps, height) + squares[:, None]
        return level.gather(1, square.argmin(1).T + columns[:, 0])


def _touching_levels(labels: Tensor, pairs: Tensor) -> Tensor:
    """Return the row of sorted pairs, (P, 2), that each pixel which touches a contour has, P if none; -1 for others."""
    other = labels
    # the first of these that differs, so the last comes first
    for down, right in ((1, 0), (0, 1), (0, -1), (-1, 0)):
        neighbour = shifted(labels, down, right)
        other = torch.where(neighbour != labels, neighbour, other)
    low, high = torch.minimum(labels, other).flatten(), torch.maximum(labels, other).flatten()
    return torch.where(other != labels, _search_pairs(pairs, low, high).reshape(labels.shape), -1)


def _search_pairs(pairs: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Return the row of sorted pairs, (P, 2), that is (low, high), by a binary search; P where there is none."""
    count = pairs.shape[0]
    first, second = pairs.unbind(1)
    begin, end = torch.zeros_like(low), torch.full_like(low, count)
    for _ in range(count.bit_length()):
        middle = (begin + end) // 2
        a, b = (ids.index_select(0, middle.clamp_max(count - 1)) for ids in (first, second))
        below = ((a < low) | ((a == low) & (b < high))) & (middle < end)
        begin, end = torch.where(below, middle + 1, begin), torch.where(below, end, middle)
    a, b = (ids.index_select(0, begin.clamp_max(count - 1)) for ids in (first, second))
    return torch.where((a == low) & (b == high), begin, count)
