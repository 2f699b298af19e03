"""The energy of a label map in contour refinement, and the moves of labels that lower it."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcgs.functional import RegionMap, blur, gaussian_taps, region_splat
from kcgs.scene import Scene

from .contour_loops import (
    NOT_COUNTED,
    CostTable,
    MapEnergy,
    SweepState,
    find_small_pieces,
    map_energy_change,
    piece_energy,
    sweep_pixels,
)

Ints = NDArray[np.int64]
Labels = NDArray[np.int32]
Mask = NDArray[np.bool_]

# unit of the sides of rendered boxes, in pixels; larger units make fewer batches of larger boxes
_BOX_UNIT = 16
# most pixels of a batch of boxes
_BATCH_PIXELS = 1 << 20


def index_map(regions: RegionMap, labels: Tensor) -> Labels:
    """Return the index of each label, (H, W), among the ids of a map on the CPU; -1 for a label that the map lacks."""
    return np.asarray(regions.index_of(labels).numpy(), dtype=np.int32)


def bounding_boxes(index: Labels, count: int, margin: int) -> Ints:
    """Return (R, 4) top, bottom, left, right of each region, grown by the margin; zeros for a region without pixels."""
    from scipy.ndimage import find_objects

    boxes = np.zeros((count, 4), np.int64)
    for region, sides in enumerate(find_objects(index + 1, max_label=count)):
        if sides is not None:
            boxes[region] = [end for side in sides for end in (side.start - margin, side.stop + margin)]
    return boxes.clip(0, np.repeat(index.shape, 2))


def region_costs(scene: Scene, image: Tensor, boxes: Ints, pad: int, sigma: float, backend: str) -> CostTable:
    """Return the blurred squared error of each region's Gaussians rendered alone, inside the region's box.

    Pixels are flat indices into the image with a rim of `pad`.
    """
    field, regions = scene.field, scene.regions
    assert regions is not None and field.region_ids is not None
    owners, order = regions.index_of(field.region_ids).sort(stable=True)
    first = torch.searchsorted(owners, torch.arange(len(boxes) + 1, device=owners.device))
    gaussians = tuple(values[order] for values in (field.means, field.cholesky, field.merged_colors()))
    starts, parts, end = np.zeros(len(boxes), np.int64), [], 0
    margin = math.ceil(4 * sigma)
    planes = torch.nn.functional.pad(torch.cat([image, torch.ones_like(image[:1])]), [margin, margin + _BOX_UNIT] * 2)
    # boxes of about the same size are rendered as one batch
    sizes = -(-(boxes[:, 1::2] - boxes[:, ::2]) // _BOX_UNIT) * _BOX_UNIT
    for size in np.unique(sizes[sizes.all(1)], axis=0):
        group = np.flatnonzero((sizes == size).all(1))
        count = max(1, _BATCH_PIXELS // size.prod())
        for members in np.split(group, range(count, len(group), count)):
            corners = torch.from_numpy(boxes[members, ::2]).to(image.device)
            batch = _pad_rows(gaussians, *(first[torch.from_numpy(members + k)] for k in (0, 1)))
            parts.append(_region_errors(batch, planes, corners, size.tolist(), sigma, backend).cpu().numpy())
            starts[members] = end + np.arange(len(members)) * size.prod()
            end += parts[-1].size
    values = np.concatenate([part.ravel() for part in parts])
    return CostTable(values, starts, boxes + pad, sizes[:, 1].copy(), image.shape[2] + 2 * pad)


def _pad_rows(gaussians: tuple[Tensor, ...], first: Tensor, end: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Make a batch of the rows from first to end, (B,), padded to the longest range with rows of the colour 0."""
    means, cholesky, colors = gaussians
    rows = first[:, None] + torch.arange(max(1, int((end - first).max())), device=first.device)
    is_member, rows = (rows < end[:, None])[:, :, None], rows.clamp_max(len(means) - 1)
    return means[rows], cholesky[rows], colors[rows] * is_member


def _region_errors(
    batch: tuple[Tensor, Tensor, Tensor], planes: Tensor, corners: Tensor, size: list[int], sigma: float, backend: str
) -> Tensor:
    """Return the blurred squared error of each scene of a batch in its box, (B, h, w); corners, (B, 2), are (y, x).

    Planes, (C + 1, H, W), are the image and a mask of its pixels, with a margin.
    """
    means, cholesky, colors = batch
    margin = math.ceil(4 * sigma)
    height, width = (side + 2 * margin for side in size)
    shift = (corners.flip(1) - margin)[:, None].to(means)
    rendered = region_splat(means - shift, cholesky, colors, size=(height, width), backend=backend)
    crops = torch.stack([planes[:, y : y + height, x : x + width] for y, x in corners.tolist()])
    error = (rendered - crops[:, :-1]).square_().mean(1) * crops[:, -1]
    total, within = blur(torch.stack([error, crops[:, -1]]), gaussian_taps(sigma, margin))
    mean: Tensor = total / within
    return mean


class MovingLabels:
    """A label map that changes; it is flat with a rim of -1, so that a neighbour's index is a sum."""

    def __init__(self, index: Labels, costs: CostTable, length_weight: float, pad: int, smallest: int) -> None:
        padded = np.pad(index, pad, constant_values=-1)
        self.map = padded[pad:-pad, pad:-pad]
        self._labels, self._before = padded.reshape(-1), padded.flatten()
        self._smallest, self._pad, self._stride = smallest, pad, padded.shape[1]
        self._sides = disc(1, self._stride)[1:]
        # a pair of neighbours that differ counts an eighth for each of its two pixels
        self._energy = MapEnergy(self._labels, costs, length_weight / 4, disc(2, self._stride))
        self._areas = np.bincount(index.ravel())
        self._floor = np.minimum(self._areas, smallest)
        self._free = self._labels >= 0
        self._specks = np.zeros(padded.size, np.bool_)  # True in pieces that were small before all moves
        self._specks[self._list_small_pieces()[0]] = True
        self._limit = np.zeros(0, np.int32), np.zeros(0, np.int64)  # empty: a pixel may take any label
        counts = np.full(padded.size, NOT_COUNTED, np.int8)
        self._sweeps = SweepState(np.ones(padded.size, np.uint8), counts)

    def fix_cores(self, rim: Mask, distance: int) -> None:
        """Pin the deepest pixels of regions that contours could erase by moving up to `distance` pixels."""
        depth, is_near = np.zeros(rim.shape, np.int16), rim
        for _ in range(distance + 1):  # chessboard distance: a distance transform takes ten times as long
            depth += ~is_near
            is_near = _grow(is_near)
        deep = self._areas - np.bincount(self.map[depth <= distance], minlength=len(self._areas))
        pixels = np.flatnonzero(np.take(deep < self._floor, self.map))
        y, x = np.divmod(pixels, rim.shape[1])
        region = self.map[y, x]
        order = np.lexsort((-depth[y, x], region))
        rank = np.arange(len(order)) - np.searchsorted(region[order], region[order])
        fixed = order[rank < self._floor[region[order]]]
        self._free[(y[fixed] + self._pad) * self._stride + x[fixed] + self._pad] = False

    def limit_moves(self, anchor: Labels, distance: float) -> None:
        """Allow a pixel only the labels that the anchor has within the distance."""
        # edge padding adds no label: the pixel that it repeats is nearer
        self._limit = np.pad(anchor, self._pad, mode="edge").reshape(-1), disc(distance, self._stride)

    def sweep(self, reach: int) -> bool:
        """Give every free pixel near a contour its best label; True if a pixel changed."""
        neighborhood = disc(reach, self._stride)
        return bool(sweep_pixels(self._energy, self._limit, self._free, self._list_edges(), neighborhood, self._sweeps))

    def _list_edges(self) -> Ints:
        """List, in order, the pixels whose label differs from that of the pixel to the right or below."""
        here, stride = self._labels[: -self._stride], self._stride
        return np.flatnonzero((here != self._labels[1 : 1 - stride]) | (here != self._labels[stride:]))

    def _list_small_pieces(self) -> tuple[Ints, Ints]:
        pixels, first = find_small_pieces(self._labels, self._list_edges(), self._stride, self._smallest)
        return pixels, first

    def merge_pieces(self) -> bool:
        """Merge small pieces that moves have made into their neighbours, the smallest first; True if any was merged.

        Each call that returns True leaves fewer pieces, so repeated calls end.
        """
        pixels, pieces = self._list_small_pieces()
        order = np.lexsort((pixels, pieces))
        pixels, pieces = pixels[order], pieces[order]
        areas = np.bincount(self.map.ravel(), minlength=len(self._floor))
        changed = np.zeros(len(self._labels), np.bool_)
        for piece in sorted(np.split(pixels, np.flatnonzero(np.diff(pieces)) + 1), key=len):
            # a piece beside a merged piece may be larger now: the next call judges it
            if not len(piece) or changed[piece[:, None] + self._sides].any():
                continue
            source, target = self._labels[piece[0]], self._best_label(piece, areas)
            self._labels[piece], changed[piece] = target, source != target
            areas[source] -= len(piece)
            areas[target] += len(piece)
        return bool(changed.any())

    def _best_label(self, piece: Ints, areas: Ints) -> int:
        """Return the adjacent label that costs a piece least; the present label where the piece must stay."""
        present = int(self._labels[piece[0]])
        was_small = bool((self._specks[piece] & (self._before[piece] == present)).any())
        if was_small or areas[present] - len(piece) < self._floor[present]:
            return present
        targets = set(self._labels[piece[:, None] + self._sides].ravel().tolist()) - {present, -1}
        energies = {label: piece_energy(self._energy, self._limit, piece, label) for label in sorted(targets)}
        best = min(energies, key=lambda label: energies[label], default=present)
        return best if energies.get(best, math.inf) < math.inf else present

    def energy_change(self) -> float:
        """Return the energy of the map minus its energy before all moves."""
        return float(map_energy_change(self._before, self._energy))


def _grow(mask: Mask) -> Mask:
    """Add the eight neighbours of each pixel of a mask."""
    for axis in (0, 1):
        lines, grown = np.moveaxis(mask, axis, 0), np.moveaxis(mask.copy(), axis, 0)
        grown[1:] |= lines[:-1]
        grown[:-1] |= lines[1:]
        mask = np.moveaxis(grown, 0, axis)
    return mask


def disc(radius: float, stride: int) -> Ints:
    """Return the offsets within the radius as flat indices, the nearest first."""
    y, x = np.mgrid[-int(radius) : int(radius) + 1, -int(radius) : int(radius) + 1]
    square = y * y + x * x
    inside = square <= radius * radius
    return np.asarray((y * stride + x)[inside][np.argsort(square[inside], kind="stable")], dtype=np.int64)
