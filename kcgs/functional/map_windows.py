"""Membership of one tile at a time from labels and softness alone: `kcgs.maps.membership` in standard operators.

Nothing is cached beside a map and no shape depends on values, so that a graph can hold it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kcgs._sizes import is_equal
from kcgs.maps import LEAST_BLUR, RADIUS_SIGMAS, MapTable, antialias, sharpness, truncated_gaussian

_TINY = 1e-30  # less than any sum of a blur
_LARGEST_EXPONENT = 64  # of memberships: float32 holds the powers


class MapWindows:
    """A map at the size of an image, by tiles.

    `tables` is computed once. A loop of a graph is handed all tensors that it reads; it passes `tables` to `read_tile`.
    """

    def __init__(self, table: MapTable, size: tuple[int, int], side: int, dtype: torch.dtype) -> None:
        """Prepare tiles of `side` pixels of an image (height, width); memberships are computed in `dtype`."""
        labels = table.labels
        device = labels.device
        self.side, self.dtype = side, dtype
        self.is_resized = not all(is_equal(new, old) for new, old in zip(size, labels.shape[-2:], strict=True))
        self.soft = table.blurs is not None or self.is_resized
        self.has_widths = table.width_index is not None
        taps = 1 if table.blurs is None else table.blurs.shape[1] - 1
        least = math.ceil(RADIUS_SIGMAS * LEAST_BLUR) if self.is_resized else 0
        self.reach = max(taps - 1, least)
        # pixels around a pixel whose regions may have a part of it: antialiasing reaches one farther than the blur
        self.margin = self.reach + self.is_resized
        down, across = (self._axis(size[k], labels.shape[k - 2], device) for k in (0, 1))
        self._tables_per_axis = len(down)
        maps = labels if labels.ndim == 3 else labels[None]
        numbers = torch.stack([torch.full((), n, dtype=torch.int64, device=device) for n in maps.shape])
        images, self._widths = self._soft_tables(maps, table, size) if self.soft else ((), ())
        self.tables = (numbers, *down, *across, *(image.flatten() for image in (maps, *images)), *self._widths)

    def _soft_tables(
        self, maps: Tensor, table: MapTable, size: tuple[int, int]
    ) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        """Return the images that are read beside the labels; and squared widths of contours, taps, and ratios."""
        widths = torch.zeros(1, dtype=torch.float64, device=maps.device)
        width_index = torch.zeros_like(maps)
        if table.blurs is not None:
            widths = table.blurs[:, 0]
        images: tuple[Tensor, ...] = ()
        if table.width_index is not None:
            width_index = table.width_index.long()
            images = (width_index,)
        blurs = widths
        sides = [torch.full((), n, dtype=torch.float64, device=maps.device) for n in (*maps.shape[-2:], *size)]
        ratio = torch.stack([sides[2] / sides[0], sides[3] / sides[1]])
        if self.is_resized:
            is_native = (ratio == 1).all()  # a graph for any size may run at the map's own
            is_sharp = widths.index_select(0, width_index.flatten()).reshape(maps.shape) < LEAST_BLUR
            weight, other, other_weight = antialias(maps, is_sharp)
            blurs = torch.where(is_native, widths, widths.clamp_min(LEAST_BLUR))
            weight, other_weight = torch.where(is_native, 1.0, weight), torch.where(is_native, 0.0, other_weight)
            images = (*images, weight.to(self.dtype), other, other_weight.to(self.dtype))
        taps = truncated_gaussian(torch.arange(self.reach + 1, device=maps.device), blurs[:, None])
        return images, (widths.square(), taps, ratio)

    def _axis(self, new: int, length: int, device: torch.device) -> tuple[Tensor, ...]:
        """Return the lines of each tile's window, and, if the map is resized, its matrix of interpolation."""
        count = (new + self.side - 1) // self.side
        if not self.is_resized:
            return self._lines(torch.arange(count, device=device) * self.side, self.side, length)
        # the last pixel is repeated past the edge
        pixels = torch.arange(count * self.side, device=device).clamp_max(new - 1)
        # place of each pixel among the pixels of the map
        place = ((2 * pixels + 1).double() * length - new) / (2 * new)
        low = place.floor().reshape(count, -1, 1)
        weight = (place.reshape(count, -1, 1) - low).to(self.dtype)
        first = low[:, 0, 0].long().clamp(0, length - 1)
        span = (self.side * length + new - 1) // new + 2
        window = (first[:, None] + torch.arange(span, device=device))[:, None]
        before, after = ((end.long().clamp(0, length - 1) == window).to(self.dtype) for end in (low, low + 1))
        return (*self._lines(first, span, length), before * (1 - weight) + after * weight)

    def _lines(self, first: Tensor, span: int, length: int) -> tuple[Tensor, Tensor]:
        """Return the clamped rows or columns of windows of `span` pixels with a halo, and which are in the image."""
        lines = torch.arange(span + 2 * self.margin, device=first.device) - self.margin
        lines = first[:, None] + lines
        return lines.clamp(0, length - 1), ((lines >= 0) & (lines < length)).to(self.dtype)

    # the methods below run inside a loop, which hands in the tables

    def read_tile(self, tables: Sequence[Tensor], image: Tensor, row: Tensor, column: Tensor) -> tuple[Tensor, ...]:
        """Read the window of tile (row, column) of an image: its sorted labels, then the operands of `membership`."""
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
        ids = window.flatten().sort()[0]
        if not self.soft:
            return ids, window
        variances, taps, ratio = tables[-len(self._widths) :]
        width = torch.zeros_like(ids[:1])
        if self.has_widths:
            width = self._crop(images.pop(0), self.margin).flatten()
        mirrored = torch.arange(-self.reach, self.reach + 1, device=window.device).abs()
        blurs = taps.to(self.dtype).index_select(0, width).index_select(1, mirrored)
        operands = (window, down[1], across[1], blurs)
        if not self.is_resized:
            return ids, *operands
        sides = [n - 2 * self.margin for n in window.shape]
        variance = variances.to(self.dtype).index_select(0, width).expand(sides[0] * sides[1]).reshape(sides)
        exponent = sharpness(down[2] @ variance @ across[2].T, ratio.prod().to(self.dtype))
        exponent = torch.where((ratio == 1).all(), 1.0, exponent.clamp_max(_LARGEST_EXPONENT))
        return ids, *operands, *images, down[2], across[2], exponent

    def membership(self, operands: Sequence[Tensor], region: Tensor) -> Tensor:
        """Evaluate the membership of a tile's pixels in a region, (1,); `operands` come from `read_tile`.

        If the map is resized, the caller divides memberships by their sum over the regions.
        """
        window, *soft = operands
        inside = (window == region).to(self.dtype)
        if not soft:
            return inside
        rows_inside, columns_inside, blurs, *interpolation = soft
        if interpolation:
            weight, other, other_weight, rows, columns, exponent = interpolation
            inside = inside * weight + (other == region).to(self.dtype) * other_weight
        margin = self.margin - self.reach
        down, across = (t[margin : t.shape[0] - margin] for t in (rows_inside, columns_inside))
        membership = self._blur(self._crop(inside, margin) * down[:, None] * across, blurs, down, across)
        return (rows @ membership @ columns.T).clamp_min(0) ** exponent if interpolation else membership

    def _crop(self, window: Tensor, margin: int) -> Tensor:
        return window[margin : window.shape[0] - margin, margin : window.shape[1] - margin]

    def _blur(self, inside: Tensor, blurs: Tensor, rows_inside: Tensor, columns_inside: Tensor) -> Tensor:
        """Blur a window by one kernel, (1, 2 R + 1), or by a kernel for each pixel inside of its halo of R."""
        taps = 2 * self.reach + 1
        height, width = (n - taps + 1 for n in inside.shape)
        steps = torch.arange(taps, device=inside.device)
        rows, columns = ((torch.arange(n, device=inside.device)[:, None] + steps).flatten() for n in (height, width))
        kernels = blurs.expand(height * width, taps).reshape(height, width, taps)
        near_rows = rows_inside.index_select(0, rows).reshape(height, 1, taps)
        near_columns = columns_inside.index_select(0, columns).reshape(width, taps)
        total = (kernels * near_rows).sum(-1) * (kernels * near_columns).sum(-1)
        # along rows, including rows of the halo; then along columns
        blurred = inside.T.index_select(0, columns).reshape(width, taps, -1)
        blurred = kernels.permute(1, 0, 2) @ blurred  # [width, height, height + 2 R]
        blurred = blurred.gather(2, rows.reshape(1, height, taps).expand(width, height, taps))
        return (blurred * kernels.permute(1, 0, 2)).sum(-1).T / total.clamp_min(_TINY)
