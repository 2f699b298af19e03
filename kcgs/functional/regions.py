"""Label maps: check, compact, look up at centres, soft contours, rescale, edge band."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from kcgs._check import check_floating, check_labels, check_size
from kcgs.kernels import Membership

MAX_SOFTNESS = 64.0


@dataclass(frozen=True, eq=False)
class RegionMap:
    r"""A label map made ready for rendering: which region each pixel belongs to, and how sharply.

    Convention: ids are any non-negative integers. With ``softness`` 0 a pixel belongs to its label alone (the paper's
    rule). Above 0 the membership of region r is the blur of [M = r] by a Gaussian of that standard deviation, cut at
    4 standard deviations, normalised to sum to one: pixels farther than that from a contour are unchanged.

    Example:
        >>> regions = RegionMap.from_labels(torch.tensor([[3, 3, 7], [3, 7, 7]]))
        >>> regions.num_regions, regions.size, regions.softness
        (2, (2, 3), 0.0)
    """

    labels: Tensor  # (H, W) or (B, H, W) int64
    ids: Tensor  # (R,) int64, sorted
    softness: float = 0.0
    _membership: Membership = field(repr=False, kw_only=True)
    _table: Tensor | None = field(repr=False, kw_only=True)

    @classmethod
    def from_labels(cls, labels: Tensor, softness: float = 0.0) -> RegionMap:
        r"""Build from a label map.

        Args:
            labels: integer, :math:`(H, W)` or :math:`(B, H, W)`, non-negative; ids need not be consecutive.
            softness: contour width (standard deviation) in pixels, 0 to 64.

        Raises:
            TypeError: labels are not an integer tensor.
            ValueError: wrong shape, no pixels, negative ids, softness out of range.
        """
        labels = check_labels("labels", labels)
        if isinstance(softness, bool) or not isinstance(softness, int | float):
            raise TypeError(f"softness must be a number of pixels; got {softness!r}")
        softness = float(softness)
        if not 0.0 <= softness <= MAX_SOFTNESS:
            raise ValueError(f"softness must be in [0, {MAX_SOFTNESS:g}] pixels; got {softness!r}")
        ids, index, table = _compact(labels)
        batched = index if index.ndim == 3 else index[None]
        return cls(labels, ids, softness, _membership=Membership(batched, len(ids), softness), _table=table)

    @property
    def num_regions(self) -> int:
        """Number of distinct ids."""
        return len(self.ids)

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        return self.labels.shape[-2], self.labels.shape[-1]

    def index_of(self, region_ids: Tensor) -> Tensor:
        """Return the position of each id among `ids`, -1 where the map does not hold it."""
        if self._table is not None:
            # not self._table[...]: that wakes torch's threads, which then spin beside the kernel's
            at = region_ids.clamp(-1, len(self._table) - 1).flatten() % len(self._table)
            return self._table.index_select(0, at).view(region_ids.shape)
        at = torch.searchsorted(self.ids, region_ids.contiguous()).clamp_max(self.num_regions - 1)
        return torch.where(self.ids[at] == region_ids, at, -1)

    def to(self, device: torch.device | str) -> RegionMap:
        """Return the map on another device."""
        device = torch.device(device)
        if device == self.labels.device:
            return self
        return RegionMap(
            self.labels.to(device),
            self.ids.to(device),
            self.softness,
            _membership=self._membership.to(device),
            _table=None if self._table is None else self._table.to(device),
        )

    def resize(self, size: tuple[int, int]) -> RegionMap:
        """Sample the map at another resolution; contours are smoothed, not stepped, and the softness scales along.

        Between pixel centres a point has the label with the largest share among its four neighbours (bilinear
        weights; the nearest neighbour's label on a tie). At the centres that is the map itself, so that the same size
        gives the same map.

        Args:
            size: (height, width).

        Raises:
            TypeError, ValueError: not two positive integers.

        Example:
            >>> RegionMap.from_labels(torch.eye(3).long()).resize((6, 6)).labels[0]
            tensor([1, 1, 0, 0, 0, 0])
        """
        height, width = check_size("size", size)
        if (height, width) == self.size:
            return self
        scale = math.sqrt(height * width / (self.size[0] * self.size[1]))
        softness = min(self.softness * scale, MAX_SOFTNESS)
        return RegionMap.from_labels(_sample_labels(self.labels, height, width), softness)


def _compact(labels: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
    """Return the sorted ids, each pixel's position among them, and for small ids a table from id to position.

    The table ends with -1, for ids beyond it and for -1.
    """
    highest = int(labels.max())
    if highest < 1 << 16:  # a table is ten times faster than sorting every pixel
        present = torch.zeros(highest + 1, dtype=torch.bool, device=labels.device)
        present[labels.flatten()] = True
        ids = present.nonzero().flatten()
        table = torch.where(present, present.cumsum(0) - 1, -1)
        return ids, table.to(torch.int32)[labels], torch.nn.functional.pad(table, (0, 1), value=-1)
    ids, index = torch.unique(labels, return_inverse=True)
    return ids, index.to(torch.int32), None


def _sample_labels(labels: Tensor, height: int, width: int) -> Tensor:
    old_h, old_w = labels.shape[-2:]

    def neighbours(new: int, old: int) -> tuple[Tensor, Tensor, Tensor]:
        at = (torch.arange(new, device=labels.device, dtype=torch.float64) + 0.5) * (old / new) - 0.5
        low = at.floor()
        return low.long().clamp(0, old - 1), (low.long() + 1).clamp(0, old - 1), at - low

    top, bottom, down = neighbours(height, old_h)
    left, right, across = neighbours(width, old_w)
    corners, weights = [], []
    # nearest first, so that the first of equal scores is the nearest neighbour's
    for near_y in (True, False):
        for near_x in (True, False):
            take_bottom = (down >= 0.5) == near_y
            take_right = (across >= 0.5) == near_x
            rows, cols = torch.where(take_bottom, bottom, top), torch.where(take_right, right, left)
            weight_y, weight_x = (
                torch.where(take_bottom, down, 1 - down),
                torch.where(take_right, across, 1 - across),
            )
            corners.append(labels[..., rows[:, None], cols[None, :]])
            weights.append(weight_y[:, None] * weight_x[None, :])
    best, best_score = corners[0], torch.full_like(corners[0], -1.0, dtype=torch.float64)
    for candidate in corners:
        score = torch.stack([w * (c == candidate) for c, w in zip(corners, weights, strict=True)]).sum(0)
        better = score > best_score + 1e-12
        best, best_score = torch.where(better, candidate, best), torch.where(better, score, best_score)
    return best


def lookup_regions(means: Tensor, labels: Tensor) -> Tensor:
    r"""Read the region under each centre: labels[floor(y), floor(x)], clamped to the image.

    Args:
        means: centres (x, y) in pixels, :math:`(N, 2)` or :math:`(B, N, 2)`.
        labels: integer label map, :math:`(H, W)`, or :math:`(B, H, W)` with one map for each batch of centres.

    Returns:
        Ids, int64, :math:`(N,)` or :math:`(B, N)`.

    Raises:
        TypeError: wrong dtype.
        ValueError: wrong shapes, values that are not finite, negative ids.

    Example:
        >>> lookup_regions(torch.tensor([[0.2, 0.9], [5.0, -3.0]]), torch.tensor([[1, 2], [3, 4]]))
        tensor([1, 2])

    Source: the paper's region assignment.
    """
    means = check_floating("means", means, last=2, dims=(2, 3))
    labels = check_labels("labels", labels)
    if labels.ndim == 3 and (means.ndim != 3 or means.shape[0] != labels.shape[0]):
        raise ValueError(
            f"labels of shape {tuple(labels.shape)} need means of shape ({labels.shape[0]}, N, 2); got "
            f"{tuple(means.shape)}"
        )
    height, width = labels.shape[-2:]
    cell = means.detach().floor()
    x, y = cell[..., 0].clamp(0, width - 1).long(), cell[..., 1].clamp(0, height - 1).long()
    if labels.ndim == 2:
        return labels[y, x]
    return labels.flatten(1).gather(1, y * width + x)


def edge_band(labels: Tensor, width: float = 5) -> Tensor:
    r"""Mark the pixels near a contour: those whose distance to a pixel of another label is at most `width`.

    Convention: Euclidean distance between pixel centres, so that a pixel beside a change has distance 1. The band
    lies on both sides of the contour.

    Args:
        labels: integer label map, :math:`(H, W)` or :math:`(B, H, W)`.
        width: in pixels, at least 1.

    Returns:
        Boolean, shape of `labels`; all False where there is one region.

    Raises:
        TypeError: labels are not integer.
        ValueError: wrong shape, negative ids, width below 1 or not finite.

    Example:
        >>> edge_band(torch.tensor([[0, 0, 0, 0, 9, 9]]), width=2).int()
        tensor([[0, 0, 1, 1, 1, 1]], dtype=torch.int32)

    Source: the paper's edge-focused evaluation (5 pixels inward and outward).
    """
    labels = check_labels("labels", labels)
    if not (1 <= width < math.inf):
        raise ValueError(f"width must be a finite number of at least 1 pixel; got {width!r}")
    height, breadth = labels.shape[-2:]
    band = torch.zeros_like(labels, dtype=torch.bool)
    width = min(width, math.hypot(height, breadth))
    for dy in range(min(int(width), height - 1) + 1):
        reach = min(int(math.sqrt(width * width - dy * dy)), breadth - 1)
        for dx in range(-reach if dy else 1, reach + 1):
            here = (..., slice(0, height - dy), slice(max(0, -dx), breadth - max(0, dx)))
            there = (..., slice(dy, height), slice(max(0, dx), breadth - max(0, -dx)))
            differs = labels[here] != labels[there]
            band[here] |= differs
            band[there] |= differs
    return band
