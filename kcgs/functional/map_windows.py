"""Membership of one tile at a time from labels and softness alone: `kcgs.kernels.membership` in standard operators.

Nothing is cached beside a map and no shape depends on values, so that a graph can hold it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kcgs.kernels.resampled import sharpness

from .labels import most_shared, sample_places
from .map_tables import MapOperands
from .sizes import is_equal

_FAR = 1e12  # more than any squared distance
_TINY = 1e-30  # less than any sum of a blur


class MapWindows:
    """A map at the size of an image, by tiles.

    `tables` is computed once. Loops of a graph are handed all tensors that they read, and hand it to `read_tile`.
    """

    def __init__(self, regions: MapOperands, side: int, dtype: torch.dtype) -> None:
        """Prepare tiles of `side` pixels; memberships are computed in `dtype`."""
        labels, softness, size = regions
        device = labels.device
        self.side, self.dtype = side, dtype
        self.soft = softness is not None
        self.pairs = softness is not None and softness.ndim == 2
        self.reach = 0 if softness is None else softness.shape[-1] - (4 if self.pairs else 2)
        # the nearest contour of a pixel of several regions is no farther away than this
        self.search = math.ceil(math.sqrt(2) * self.reach)
        self.halo = self.search + 1 if self.pairs else self.reach
        self.is_resized = not all(is_equal(new, old) for new, old in zip(size, labels.shape[-2:], strict=True))
        axis = self._soft_axis if self.soft else self._hard_axis
        down, across = (axis(size[k], labels.shape[k - 2], device) for k in (0, 1))
        self._tables_per_axis = len(down)
        shape = (labels.shape[0] if labels.ndim == 3 else 1, *labels.shape[-2:])
        numbers = torch.stack([torch.full((), n, dtype=torch.int64, device=device) for n in shape])
        self.tables: tuple[Tensor, ...] = (numbers, labels.flatten(), *down, *across)
        if softness is not None:
            sides = [torch.full((), n, dtype=torch.float64, device=device) for n in (*labels.shape[-2:], *size)]
            enlargement = (1 - sides[0] * sides[1] / (sides[2] * sides[3])).clamp_min(0).to(dtype)
            self.tables = (*self.tables, enlargement, softness)

    def _hard_axis(self, new: int, length: int, device: torch.device) -> tuple[Tensor, ...]:
        """Return the pixels of the rows, or columns, of tiles: both neighbours and their shares where resized."""
        count = (new + self.side - 1) // self.side
        # the last pixel is repeated past the edge
        pixels = torch.arange(count * self.side, device=device).clamp_max(new - 1)
        if not self.is_resized:
            return (pixels.reshape(count, -1),)
        ends, shares = sample_places(new, length, device)
        parts = (*ends, *shares.to(self.dtype))
        return tuple(part.index_select(0, pixels).reshape(count, -1) for part in parts)

    def _soft_axis(self, new: int, length: int, device: torch.device) -> tuple[Tensor, ...]:
        """Return the lines of the windows of tiles, and a matrix of interpolation for each where resized."""
        count = (new + self.side - 1) // self.side
        if not self.is_resized:
            return self._lines(torch.arange(count, device=device) * self.side, self.side, length)
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
        labels, first_row = tables[1], image % maps * height
        down, across = (
            [
                table.index_select(0, place.reshape(1)).squeeze(0)
                for table in tables[start : start + self._tables_per_axis]
            ]
            for place, start in ((row, 2), (column, 2 + self._tables_per_axis))
        )

        def read(rows: Tensor, columns: Tensor) -> Tensor:
            places = (first_row + rows)[:, None] * width + columns
            return labels.index_select(0, places.flatten()).reshape(places.shape)

        if not self.soft and self.is_resized:
            shares = torch.stack([d[:, None] * a for d in down[2:] for a in across[2:]])
            corners = torch.stack([read(rows, columns) for rows in down[:2] for columns in across[:2]])
            window = most_shared(corners, shares)
        else:
            window = read(down[0], across[0])
        # pixels beyond the reach of a blur say which contour is near, but are of no region here
        ids = self._crop(window, self.halo - self.reach).flatten().sort()[0]
        if not self.soft:
            return ids, window
        enlargement, softness = tables[-2:]
        blurs, variance = self._blurs(softness, ids, window, down[1], across[1])
        taps = torch.arange(-self.reach, self.reach + 1, device=labels.device).abs()
        operands = (window, down[1], across[1], blurs.to(self.dtype).index_select(1, taps))
        if not self.is_resized:
            return ids, *operands
        sides = [n - 2 * self.halo for n in window.shape]
        variances = variance.to(self.dtype).expand(sides[0] * sides[1]).reshape(sides)
        exponent = sharpness(down[2] @ variances @ across[2].T, enlargement)
        return ids, *operands, down[2], across[2], exponent

    def membership(self, operands: Sequence[Tensor], region: Tensor) -> Tensor:
        """Evaluate the membership of a tile's pixels in a region, (1,); `operands` are what `read_tile` found.

        Of a soft map at another size they are to be divided by their sum over the regions.
        """
        window, *soft = operands
        if not soft:
            return (window == region).to(self.dtype)
        rows_inside, columns_inside, blurs, *interpolation = soft
        margin = self.halo - self.reach
        down, across = (t[margin : t.shape[0] - margin] for t in (rows_inside, columns_inside))
        inside = (self._crop(window, margin) == region).to(self.dtype) * down[:, None] * across
        membership = self._blur(inside, blurs, down, across)
        if not interpolation:
            return membership
        rows, columns, exponent = interpolation
        return (rows @ membership @ columns.T).clamp_min(0) ** exponent

    def _blurs(
        self, softness: Tensor, ids: Tensor, window: Tensor, rows_inside: Tensor, columns_inside: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return half of the blur, (1, 1 + R), and its variance (1,); or those of each pixel inside of the halo."""
        if not self.pairs:
            return softness[None, 1:], softness[:1].square()
        # where there is one region, any blur is right
        level = torch.ops.higher_order.cond(
            ids[0] != ids[-1],
            lambda *operands: self._nearest_levels(*operands),
            lambda *operands: self._no_levels(*operands),
            (window, softness, rows_inside, columns_inside),
        )[0]
        hard = (torch.arange(self.reach + 1, device=window.device) == 0).to(softness.dtype)
        blurs, variances = torch.cat([softness[:, 3:], hard[None]]), softness[:, 2].square()
        variances = torch.cat([variances, torch.zeros_like(variances[:1])])
        return blurs.index_select(0, level), variances.index_select(0, level)

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

    def _no_levels(self, window: Tensor, *_: Tensor) -> tuple[Tensor]:
        return (torch.zeros_like(self._crop(window, self.halo).flatten()),)

    def _nearest_levels(
        self, window: Tensor, softness: Tensor, rows_inside: Tensor, columns_inside: Tensor
    ) -> tuple[Tensor]:
        """Return for each pixel inside of the halo the row of `softness` that is its nearest contour's.

        A contour between regions that `softness` does not name is hard: one row beyond the last.
        """
        label = window[1:-1, 1:-1]
        other = label
        # the first of these that differs, so the last comes first
        for neighbour in (window[2:, 1:-1], window[1:-1, 2:], window[1:-1, :-2], window[:-2, 1:-1]):
            other = torch.where(neighbour != label, neighbour, other)
        touches = (other != label) & (rows_inside[1:-1, None] * columns_inside[1:-1] > 0)
        low, high = (torch.where(label < other, *ends).flatten() for ends in ((label, other), (other, label)))
        level = _search_pairs(softness[:, :2].long(), low, high).reshape(label.shape)
        return (self._nearest(touches, level).flatten(),)

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
