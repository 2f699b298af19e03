"""Region weights of one tile at a time from labels and widths alone: `kcgs.kernels.membership` in standard operators.

Nothing is kept beside a map and no shape depends on values, so that a graph can hold it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kcgs.kernels.resampled import sharpness

from .arguments import Arguments
from .labels import most_shared, sample_places

_FAR = 1e12  # more than any squared distance
_TINY = 1e-30


class MapWindows:
    """A map at the size of an image, by tiles; what it computes once is in `tables`, for loops to hand back."""

    def __init__(self, given: Arguments, side: int) -> None:
        """Take the map of these arguments, and the pixels along a side of a tile."""
        from torch.fx.experimental.symbolic_shapes import statically_known_true

        labels, widths = given.labels, given.softness
        assert labels is not None
        self.side, self.dtype = side, given.means.dtype
        self.soft, self.pairs = widths is not None, widths is not None and widths.ndim == 2
        self.reach = 0 if widths is None else widths.shape[-1] - (4 if self.pairs else 2)
        # the nearest contour of a pixel that is not of one region alone is within
        self.search = math.ceil(math.sqrt(2) * self.reach)
        self.halo = self.search + 1 if self.pairs else self.reach
        axes = tuple(zip((given.height, given.width), labels.shape[-2:], strict=True))
        self.resized = not all(statically_known_true(old == new) for new, old in axes)
        sizes = (labels.shape[0] if labels.ndim == 3 else 1, *labels.shape[-2:])
        counts = [
            torch.full((), n, dtype=torch.float64, device=labels.device)
            for n in (*labels.shape[-2:], given.height, given.width)
        ]
        lost = (1 - counts[0] * counts[1] / (counts[2] * counts[3])).clamp_min(0).to(self.dtype)
        numbers = torch.stack([torch.full((), n, dtype=torch.int64, device=labels.device) for n in sizes])
        down, across = (self._axis(*axis, labels.device) for axis in axes)
        self._per_axis = len(down)
        self.tables = (numbers, labels.flatten(), *down, *across, *(() if widths is None else (lost, widths)))

    def _axis(self, new: int, length: int, device: torch.device) -> tuple[Tensor, ...]:
        """Return tables of the rows, or columns, of tiles; the last pixel is repeated past the edge."""
        count = (new + self.side - 1) // self.side
        pixels = torch.arange(count * self.side, device=device).clamp_max(new - 1)
        if self.soft and not self.resized:
            return self._windows(torch.arange(count, device=device) * self.side, self.side, length)
        if not self.soft:
            if not self.resized:
                return (pixels.reshape(count, -1),)
            ends, shares = sample_places(new, length, device)
            parts = (*ends, *shares.to(self.dtype))
            return tuple(part.index_select(0, pixels).reshape(count, -1) for part in parts)
        # between which pixels of the map each pixel lies, and how far
        place = ((2 * pixels + 1).double() * length - new) / (2 * new)
        low = place.floor().reshape(count, -1, 1)
        weight = (place.reshape(count, -1, 1) - low).to(self.dtype)
        first = low[:, 0, 0].long().clamp(0, length - 1)
        span = (self.side * length + new - 1) // new + 2
        window = (first[:, None] + torch.arange(span, device=device))[:, None]
        before, after = ((end.long().clamp(0, length - 1) == window).to(self.dtype) for end in (low, low + 1))
        return (*self._windows(first, span, length), before * (1 - weight) + after * weight)

    def _windows(self, first: Tensor, span: int, length: int) -> tuple[Tensor, Tensor]:
        """Return the lines of windows of `span` pixels with a halo, held at the border, and which are inside."""
        lines = torch.arange(span + 2 * self.halo, device=first.device) - self.halo
        lines = first[:, None] + lines
        return lines.clamp(0, length - 1), ((lines >= 0) & (lines < length)).to(self.dtype)

    # Inside a loop, which hands in the tables

    def look(self, tables: Sequence[Tensor], image: Tensor, row: Tensor, column: Tensor) -> tuple[Tensor, ...]:
        """Read what tile (row, column) of an image sees: its labels, sorted, and what `weigh` takes."""
        maps, height, width = tables[0].unbind()
        labels, first = tables[1], image % maps * height
        down, across = (
            [table.index_select(0, place.reshape(1)).squeeze(0) for table in tables[begin : begin + self._per_axis]]
            for place, begin in ((row, 2), (column, 2 + self._per_axis))
        )

        def read(rows: Tensor, columns: Tensor) -> Tensor:
            places = (first + rows)[:, None] * width + columns
            return labels.index_select(0, places.flatten()).reshape(places.shape)

        if not self.soft and self.resized:
            shares = torch.stack([d[:, None] * a for d in down[2:] for a in across[2:]])
            window = most_shared(
                torch.stack([read(rows, columns) for rows in down[:2] for columns in across[:2]]), shares
            )
        else:
            window = read(down[0], across[0])
        # farther pixels say how wide contours are, but have no weight
        edge = self.halo - self.reach
        ids = window[edge : window.shape[0] - edge, edge : window.shape[1] - edge].flatten().sort()[0]
        if not self.soft:
            return ids, window
        widths, inside = tables[-1], (down[1], across[1])
        kernels, variances = widths[None, 1:], widths[:1].square() if widths.ndim == 1 else widths[:, 2].square()
        variance = variances[:1]
        if self.pairs:
            hard = (torch.arange(self.reach + 1, device=labels.device) == 0).to(widths.dtype)
            # where there is one region, any blur is right
            find, skip = (lambda *t: self._find_levels(*t)), (lambda *t: self._no_levels(*t))
            given = window, widths, *inside
            level = torch.ops.higher_order.cond(ids[0] != ids[-1], find, skip, given)[0]
            kernels = torch.cat([widths[:, 3:], hard[None]]).index_select(0, level)
            variance = torch.cat([variances, torch.zeros_like(variances[:1])]).index_select(0, level)
        both = torch.arange(-self.reach, self.reach + 1, device=labels.device).abs()
        rest = (*down[2:], *across[2:])
        if self.resized:
            sides = [n - 2 * self.halo for n in window.shape]
            squares = variance.to(self.dtype).expand(sides[0] * sides[1]).reshape(sides)
            rest = (*rest, sharpness(rest[0] @ squares @ rest[1].T, tables[-2]))
        return ids, window, *inside, kernels.to(self.dtype).index_select(1, both), *rest

    def weigh(self, seen: Sequence[Tensor], region: Tensor) -> Tensor:
        """Evaluate the weights of a region, (1,), at the pixels of a tile, from what `look` found.

        Of a soft map at another size they are to be divided by their sum.
        """
        window = seen[0]
        if not self.soft:
            return (window == region).to(self.dtype)
        rows, columns = (slice(self.halo - self.reach, n - self.halo + self.reach) for n in window.shape)
        down, across = seen[1][rows], seen[2][columns]
        marked = (window[rows, columns] == region).to(self.dtype) * down[:, None] * across
        weights = self._blur(marked, seen[3], down, across)
        return (seen[4] @ weights @ seen[5].T).clamp_min(0) ** seen[6] if self.resized else weights

    def _blur(self, marked: Tensor, kernels: Tensor, down: Tensor, across: Tensor) -> Tensor:
        """Blur a window by one kernel, (1, 2 R + 1), or by one for each pixel inside of its halo of R."""
        taps = 2 * self.reach + 1
        height, width = (n - taps + 1 for n in marked.shape)
        steps = torch.arange(taps, device=marked.device)
        rows, columns = ((torch.arange(n, device=marked.device)[:, None] + steps).flatten() for n in (height, width))
        of_pixel = kernels.expand(height * width, taps).reshape(height, width, taps)
        near_rows = down.index_select(0, rows).reshape(height, 1, taps)
        near_columns = across.index_select(0, columns).reshape(width, taps)
        total = (of_pixel * near_rows).sum(-1) * (of_pixel * near_columns).sum(-1)
        # along rows, those of the halo too; then along columns
        spread = marked.T.index_select(0, columns).reshape(width, taps, -1)
        spread = of_pixel.permute(1, 0, 2) @ spread  # [width, height, height + 2 R]
        spread = spread.gather(2, rows.reshape(1, height, taps).expand(width, height, taps))
        return (spread * of_pixel.permute(1, 0, 2)).sum(-1).T / total.clamp_min(_TINY)

    def _no_levels(self, window: Tensor, *_: Tensor) -> tuple[Tensor]:
        rows, columns = (slice(self.halo, n - self.halo) for n in window.shape)
        return (torch.zeros_like(window[rows, columns].flatten()),)

    def _find_levels(self, window: Tensor, widths: Tensor, down: Tensor, across: Tensor) -> tuple[Tensor]:
        """Find the row of `widths` that each pixel inside of the halo has; one beyond them where contours are hard."""
        label = window[1:-1, 1:-1]
        other = label
        # the first of these that differs, so the last comes first
        for neighbour in (window[2:, 1:-1], window[1:-1, 2:], window[1:-1, :-2], window[:-2, 1:-1]):
            other = torch.where(neighbour != label, neighbour, other)
        touches = (other != label) & (down[1:-1, None] * across[1:-1] > 0)
        low, high = (torch.where(label < other, *ends).flatten() for ends in ((label, other), (other, label)))
        # a binary search in rows that are sorted
        count = widths.shape[0]
        first, second = widths[:, :2].long().unbind(1)
        begin, end = torch.zeros_like(low), torch.full_like(low, count)
        for _ in range(count.bit_length()):
            middle = (begin + end) // 2
            a, b = (v.index_select(0, middle.clamp_max(count - 1)) for v in (first, second))
            below = ((a < low) | ((a == low) & (b < high))) & (middle < end)
            begin, end = torch.where(below, middle + 1, begin), torch.where(below, end, middle)
        a, b = (v.index_select(0, begin.clamp_max(count - 1)) for v in (first, second))
        level = torch.where((a == low) & (b == high), begin, count).reshape(label.shape)
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
        seen = touches.index_select(0, rows.flatten()).reshape(height, taps, -1)
        square, step = torch.where(seen, squares[:, None], _FAR).min(1)
        level = level.gather(0, step + rows[:, :1])  # [height, width + halo]
        square = square.T.index_select(0, columns.flatten()).reshape(width, taps, height) + squares[:, None]
        return level.gather(1, square.argmin(1).T + columns[:, 0])
