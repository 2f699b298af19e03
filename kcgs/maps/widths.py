"""Widths of contours: each pixel has the width of its nearest contour, which depends on the two regions beside it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

# reach of a contour, in widths: the blur's kernel is cut there
RADIUS_SIGMAS = 4.0
# pixels: in place of 0 where a distance is divided by a width
_LEAST_WIDTH = 1e-9
# distances that are compared at once: 64 MiB in int32
_CHUNK_DISTANCES = 1 << 24
# more than any image has rows
_FAR = 1 << 24
# more than the key of any pair of regions
_NO_KEY = 1 << 62


SoftnessByPosition = float | Mapping[tuple[int, int], float]


class ContourWidths(NamedTuple):
    """The widths of contours, and the width of each pixel."""

    widths: tuple[float, ...]  # pixels, ascending
    pixels: Tensor | None  # [maps, H, W] int32, position in `widths`; None: one width everywhere


def reach_of(width: float) -> int:
    """Return how many pixels a contour of this width reaches."""
    return math.ceil(RADIUS_SIGMAS * width)


def truncated_gaussian(distance: Tensor, width: Tensor | float) -> Tensor:
    """Evaluate exp(-0.5 (distance / width)^2) up to `RADIUS_SIGMAS` widths, rounded up to whole pixels, and 0 beyond.

    Width 0 gives 1 at distance 0. Distances are not negative, and floating where the width is a number.
    """
    if isinstance(width, Tensor):
        is_near, ratio = distance <= (RADIUS_SIGMAS * width).ceil(), distance / width.clamp_min(_LEAST_WIDTH)
    else:
        is_near, ratio = distance <= reach_of(width), distance / max(width, _LEAST_WIDTH)
    return torch.where(is_near, torch.exp(-0.5 * ratio**2), 0.0)


def blurs_of(widths: Sequence[float], device: torch.device) -> Tensor:
    """Return a float64 row for each width: the width, then half of its blur, from the centre to the widest reach.

    The host does not wait for the device.
    """
    width = torch.tensor(widths, dtype=torch.float64)[:, None]
    distance = torch.arange(reach_of(max(widths)) + 1, dtype=torch.float64)
    return torch.cat([width, truncated_gaussian(distance, width)], 1).to(device, non_blocking=True)


def find_widths(
    index: Tensor, num_regions: int, softness: SoftnessByPosition | tuple[SoftnessByPosition, ...]
) -> ContourWidths:
    """Give each pixel the width of its nearest contour, on the map's device; the host does not wait.

    The nearest pixel that touches a contour has the same label, since the way to another label crosses a contour
    earlier. So the two regions of the contour are the region of that nearest pixel and the first other region beside
    it. Of pixels equally near, the leftmost counts, then the uppermost. Pixels that no contour reaches have any width.

    Args:
        index: position of each pixel's region among the sorted ids, (maps, H, W) int32.
        num_regions: number of ids.
        softness: the width in pixels, or the width of each pair (a, b) of positions with a < b, 0 where absent; or
            either for each map.
    """
    if isinstance(softness, tuple):
        parts = [find_widths(one[None], num_regions, part) for one, part in zip(index, softness, strict=True)]
        return _join_widths(parts, index)
    if not isinstance(softness, Mapping):
        return ContourWidths((softness,), None)
    search = spread_widths if index.device.type == "cpu" else search_widths
    return search(index, num_regions, softness)


def _join_widths(parts: Sequence[ContourWidths], index: Tensor) -> ContourWidths:
    """Return the widths of all maps of a batch, and the width of each pixel."""
    widths = sorted({width for part in parts for width in part.widths})
    pixels = torch.empty_like(index)
    for k, part in enumerate(parts):
        places = torch.tensor([widths.index(width) for width in part.widths], dtype=torch.int32)
        places = places.to(index.device, non_blocking=True)
        pixels[k] = places[0] if part.pixels is None else places[part.pixels[0].long()]
    return ContourWidths(tuple(widths), pixels if len(widths) > 1 else None)


def spread_widths(index: Tensor, num_regions: int, softness: Mapping[tuple[int, int], float]) -> ContourWidths:
    """Find the widths on the CPU; widths that no contour has are dropped."""
    from .nearest import spread  # loads numba

    other = _neighbor_labels(index).numpy()
    maps, touches = index.numpy(), other >= 0
    own, beside = maps[touches].astype(np.int64), other[touches]
    keys = np.minimum(own, beside) * num_regions + np.maximum(own, beside)
    pairs, pair_index = np.unique(keys, return_inverse=True)
    pair_widths = [softness.get(divmod(pair, num_regions), 0.0) for pair in pairs.tolist()]
    if len(set(pair_widths)) < 2:
        return ContourWidths((pair_widths[0] if pair_widths else 0.0,), None)
    widths, places = np.unique(pair_widths, return_inverse=True)
    contours, pixels = np.full(maps.shape, -1, np.int32), np.zeros(maps.shape, np.int32)
    contours[touches] = places[pair_index]
    spread(contours, pixels)
    return ContourWidths(tuple(widths.tolist()), torch.from_numpy(pixels))


def search_widths(index: Tensor, num_regions: int, softness: Mapping[tuple[int, int], float]) -> ContourWidths:
    """Find the widths on any device, by a search along columns, then along rows, within the reach of the widest."""
    widths = tuple(sorted({0.0, *softness.values()}))
    places = {width: place for place, width in enumerate(widths)}
    other = _neighbor_labels(index)
    pairs = torch.minimum(index, other).long() * num_regions + torch.maximum(index, other)
    own = _look_up(pairs, {a * num_regions + b: places[width] for (a, b), width in softness.items()})
    row, down = _nearest_rows(other >= 0)
    column, is_near = _nearest_columns(down, reach_of(widths[-1]))
    return ContourWidths(widths, torch.where(is_near, own.gather(1, row).gather(2, column), 0))


def _neighbor_labels(index: Tensor) -> Tensor:
    """Return the first label beside each pixel (above, left, right, below) that differs from its own; -1: none."""
    height, width = index.shape[1:]
    padded = torch.nn.functional.pad(index, (1, 1, 1, 1), value=-1)
    other = torch.full_like(index, -1)
    for down, across in ((2, 1), (1, 2), (1, 0), (0, 1)):  # in reverse order: the first neighbour is written last
        beside = padded[:, down : down + height, across : across + width]
        other = torch.where((beside >= 0) & (beside != index), beside, other)
    return other


def _look_up(keys: Tensor, values: Mapping[int, int]) -> Tensor:
    """Return the value of each key, int32; 0 where there is none."""
    rows = torch.tensor([*sorted(values.items()), (_NO_KEY, 0)]).to(keys.device, non_blocking=True)
    place = torch.searchsorted(rows[:, 0].contiguous(), keys)
    return torch.where(rows[place, 0] == keys, rows[place, 1], 0).int()


def _nearest_rows(touches: Tensor) -> tuple[Tensor, Tensor]:
    """Return the row of the nearest of the marked pixels above or below each pixel, and its distance."""
    rows = torch.arange(touches.shape[1], device=touches.device)[:, None]
    above = torch.where(touches, rows, -_FAR).cummax(1)[0]
    below = torch.where(touches, rows, _FAR).flip(1).cummin(1)[0].flip(1)
    nearest = torch.where(rows - above <= below - rows, above, below)
    return nearest.clamp(0, len(rows) - 1), (rows - nearest).abs()


def _nearest_columns(down: Tensor, reach: int) -> tuple[Tensor, Tensor]:
    """Return the column of the nearest marked pixel, and whether it is near; `down` has the distances within columns.

    Near is a distance below floor(sqrt(2) reach) + 1, so that a contour within reach along both axes is near.
    """
    maps, _, width = down.shape
    limit = math.floor(math.sqrt(2) * reach) + 1
    side = min(limit, width) - 1
    offsets = torch.arange(-side, side + 1, device=down.device, dtype=torch.int32)
    squares = torch.nn.functional.pad(down.clamp_max(limit).int().square(), (side, side), value=limit**2)
    order = len(offsets) * offsets.square() + offsets + side  # of equal distances the leftmost is the least
    length = max(1, _CHUNK_DISTANCES // (maps * width * len(offsets)))
    nearest = torch.cat(
        [(len(offsets) * part.unfold(2, len(offsets), 1) + order).amin(3) for part in squares.split(length, 1)],
        1,
    )
    column = torch.arange(width, device=down.device) + nearest % len(offsets) - side
    return column.clamp(0, width - 1), nearest // len(offsets) < limit**2
