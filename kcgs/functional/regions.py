"""Label maps: check, compact, look up at centres, soft contours, rescale, edge band."""

from __future__ import annotations

import math
import operator
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from kcgs._check import check_floating, check_labels, check_size
from kcgs.kernels import Membership, Resampled

MAX_SOFTNESS = 64.0
# places between two pixel centres that hard contours are sampled at
_OFFSETS = 1024


class PairWidths(Mapping[tuple[int, int], float]):
    """Contour width in pixels of pairs of regions: an immutable mapping with ids a < b, read in either order.

    Example:
        >>> widths = PairWidths({(1, 2): 0.7, (1, 5): 0.0})
        >>> widths[2, 1], widths
        (0.7, PairWidths({(1, 2): 0.7, (1, 5): 0.0}))
    """

    __slots__ = ("_widths",)

    def __init__(self, widths: Mapping[tuple[int, int], float]) -> None:
        self._widths = dict(sorted(((min(pair), max(pair)), width) for pair, width in widths.items()))

    def __getitem__(self, pair: tuple[int, int]) -> float:
        return self._widths[min(pair), max(pair)]

    def __iter__(self) -> Iterator[tuple[int, int]]:
        return iter(self._widths)

    def __len__(self) -> int:
        return len(self._widths)

    def __hash__(self) -> int:
        return hash(tuple(self._widths.items()))

    def __repr__(self) -> str:
        return f"PairWidths({self._widths})"


@dataclass(frozen=True, eq=False)
class RegionMap:
    r"""A label map made ready for rendering: which region each pixel belongs to, and how sharply.

    Convention: ids are any non-negative integers. With ``softness`` 0 a pixel belongs to its label alone (the paper's
    rule). Above 0 the membership of region r is the blur of [M = r] by a Gaussian of that standard deviation, cut at
    4 standard deviations, normalised to sum to one: pixels farther than that from a contour are unchanged. With a
    width for each pair of regions a pixel is blurred by the width of its nearest contour. With ``supersample`` k the
    map has k x k labels a pixel, and a pixel's membership is the mean over them; ``labels`` is then the label with
    the largest share (the smallest on a tie), and regions too small to have any such pixel are regions still.

    Example:
        >>> regions = RegionMap.from_labels(torch.tensor([[3, 3, 7], [3, 7, 7]]))
        >>> regions.num_regions, regions.size, regions.softness
        (2, (2, 3), 0.0)
    """

    labels: Tensor  # (H, W) or (B, H, W) int64
    ids: Tensor  # (R,) int64, sorted
    softness: float | PairWidths = 0.0
    fine_labels: Tensor | None = None  # (k * H, k * W) or (B, k * H, k * W) int64; None where k is 1
    supersample: int = 1  # k
    _membership: Membership = field(repr=False, kw_only=True)
    _table: Tensor | None = field(repr=False, kw_only=True)
    _origin: RegionMap | None = field(default=None, repr=False, kw_only=True)  # what this was resized from

    @classmethod
    def from_labels(
        cls, labels: Tensor, softness: float | Mapping[tuple[int, int], float] = 0.0, *, supersample: int = 1
    ) -> RegionMap:
        r"""Build from a label map.

        Args:
            labels: integer, :math:`(H, W)` or :math:`(B, H, W)`, non-negative; ids need not be consecutive. With
                ``supersample`` k it has k times the image's height and width.
            softness: contour width (standard deviation) in pixels, 0 to 64; or one for each pair of ids in any
                order, 0 for pairs that are not mentioned.
            supersample: labels along a side of a pixel, k.

        Raises:
            TypeError: labels are not an integer tensor; softness or supersample of another type.
            ValueError: wrong shape, no pixels, negative ids, softness out of range or of ids that are not in the map,
                a size that supersample does not divide.

        Example:
            >>> edge = torch.tensor([[1, 1, 1, 2], [1, 1, 1, 2]])
            >>> RegionMap.from_labels(edge, {(2, 1): 0.7}).softness
            0.7
            >>> half = RegionMap.from_labels(edge, supersample=2)
            >>> half.labels, half.num_regions
            (tensor([[1, 1]]), 2)
        """
        labels = check_labels("labels", labels)
        _check_supersample(supersample, labels)
        ids, index, table = _compact(labels)
        width = _check_softness(softness, ids)
        by_index: float | Mapping[tuple[int, int], float] = width
        if isinstance(width, PairWidths):
            position = {region: at for at, region in enumerate(ids.tolist())}
            by_index = {(position[a], position[b]): value for (a, b), value in width.items()}
        index = index if index.ndim == 3 else index[None]
        if supersample == 1:
            return cls(labels, ids, width, _membership=Membership(index, len(ids), by_index), _table=table)
        coarse = _largest_share(index, supersample)
        membership = Membership(coarse, len(ids), by_index, fine=index)
        shown = ids[coarse if labels.ndim == 3 else coarse[0]]
        return cls(shown, ids, width, labels, supersample, _membership=membership, _table=table)

    @property
    def num_regions(self) -> int:
        """Number of distinct ids."""
        return len(self.ids)

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        return self.labels.shape[-2], self.labels.shape[-1]

    @property
    def resized(self) -> bool:
        """Whether these are memberships of another map's pixels, interpolated."""
        return self._origin is not None

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
            None if self.fine_labels is None else self.fine_labels.to(device),
            self.supersample,
            _membership=self._membership.to(device),
            _table=None if self._table is None else self._table.to(device),
            _origin=None if self._origin is None else self._origin.to(device),
        )

    def resize(self, size: tuple[int, int]) -> RegionMap:
        """Sample the map at another resolution; contours are smoothed, not stepped.

        Hard contours stay hard: between pixel centres a point has the label with the largest share among its four
        neighbours (bilinear weights, of offsets rounded to odd multiples of 1/2048 pixel, so that no two labels tie).
        With ``supersample`` k it is the fine map that is sampled: the result has k x k labels a pixel as before, spread
        over the new pixel, or over one old pixel where that is smaller. Labels that are left with none are no regions.

        Soft contours widen along with the map: between pixel centres a point has the bilinear mean of its four
        neighbours' memberships. ``softness`` says the new widths; all regions stay.

        The same size gives the same map, also from one that was resized before.

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
        if self._origin is not None:
            return self._origin.resize((height, width))
        k = self.supersample
        if self.softness == 0.0:
            fine = self.labels if self.fine_labels is None else self.fine_labels
            return RegionMap.from_labels(_sample_labels(fine, height, width, k), supersample=k)
        labels = _sample_labels(self.labels, height, width, 1)
        index = self.index_of(labels).to(torch.int32)
        return RegionMap(
            labels,
            self.ids,
            _scaled(self.softness, math.sqrt(height * width / (self.size[0] * self.size[1]))),
            _membership=Resampled(index if index.ndim == 3 else index[None], self._membership),
            _table=self._table,
            _origin=self,
        )


def _scaled(softness: float | PairWidths, scale: float) -> float | PairWidths:
    if not isinstance(softness, PairWidths):
        return min(softness * scale, MAX_SOFTNESS)
    return PairWidths({pair: min(width * scale, MAX_SOFTNESS) for pair, width in softness.items()})


def _check_width(name: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{name} must be a number of pixels; got {value!r}")
    if not 0.0 <= value <= MAX_SOFTNESS:
        raise ValueError(f"{name} must be in [0, {MAX_SOFTNESS:g}] pixels; got {float(value)!r}")
    return float(value)


def _check_softness(softness: object, ids: Tensor) -> float | PairWidths:
    """Return the width if all pairs have the same, else the widths of pairs."""
    if not isinstance(softness, Mapping):
        return _check_width("softness", softness)
    known: set[int] = set(ids.tolist())
    widths: dict[tuple[int, int], float] = {}
    for pair, value in softness.items():
        if not isinstance(pair, tuple) or len(pair) != 2 or not all(hasattr(i, "__index__") for i in pair):
            raise TypeError(f"softness must map pairs of ids to widths; got the key {pair!r}")
        low, high = sorted(map(operator.index, pair))
        if low == high or not known.issuperset((low, high)):
            raise ValueError(f"softness must map pairs of two different ids in the map; got {pair!r}")
        if (low, high) in widths:
            raise ValueError(f"softness must name a pair once; got {(low, high)} and {(high, low)}")
        widths[low, high] = _check_width(f"softness of {pair}", value)
    every_pair = len(widths) == len(known) * (len(known) - 1) // 2
    distinct = {*widths.values()} | (set() if every_pair else {0.0})
    return PairWidths(widths) if len(distinct) > 1 else distinct.pop() if distinct else 0.0


def _check_supersample(supersample: object, labels: Tensor) -> None:
    if isinstance(supersample, bool) or not isinstance(supersample, int):
        raise TypeError(f"supersample must be an integer; got {supersample!r}")
    if supersample < 1:
        raise ValueError(f"supersample must be at least 1; got {supersample}")
    if labels.shape[-2] % supersample or labels.shape[-1] % supersample:
        raise ValueError(f"labels must have sides that supersample, {supersample}, divides; got {tuple(labels.shape)}")


def _largest_share(index: Tensor, factor: int) -> Tensor:
    """Give each block of factor x factor its most frequent label, the smallest on a tie."""
    maps, height, width = index.shape
    split = index.reshape(maps, height // factor, factor, width // factor, factor)
    blocks = split.transpose(2, 3).flatten(-2)  # [B, H, W, factor**2]
    best = blocks.amin(-1)
    mixed = best != blocks.amax(-1)
    ordered = blocks[mixed].sort(-1).values  # [P, factor**2], equal labels in runs
    at = torch.arange(factor * factor, device=index.device)
    starts = ordered != torch.nn.functional.pad(ordered[:, :-1], (1, 0), value=-1)
    run = at - torch.where(starts, at, 0).cummax(-1).values  # place within its run
    # the longest run, then the first
    last = (run * (factor * factor) - at).argmax(-1, keepdim=True)
    best[mixed] = ordered.gather(-1, last)[:, 0]
    return best


def _compact(labels: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
    """Return the sorted ids, each pixel's position among them, and for small ids a table from id to position.

    The table ends with -1, for ids beyond it and for -1.
    """
    highest = int(labels.max())
    if highest < 1 << 16:  # a table is ten times faster than sorting every pixel
        present = torch.bincount(labels.flatten()) > 0
        ids = present.nonzero().flatten()
        table = torch.where(present, present.cumsum(0) - 1, -1)
        index = table.to(torch.int32).index_select(0, labels.flatten()).view(labels.shape)
        return ids, index, torch.nn.functional.pad(table, (0, 1), value=-1)
    ids, index = torch.unique(labels, return_inverse=True)
    return ids, index.to(torch.int32), None


def _sample_labels(labels: Tensor, height: int, width: int, factor: int) -> Tensor:
    # in integers, so that any program that draws the map puts a pixel on the same side
    def neighbours(new: int, old: int) -> tuple[Tensor, Tensor]:
        pixels = old // factor
        i = torch.arange(new, device=labels.device)[:, None]
        j = torch.arange(factor, device=labels.device)
        if pixels <= new:  # sub-pixels spread over a new pixel
            at = pixels * (2 * (i * factor + j) + 1) - new
        else:  # over an old one
            at = factor * (2 * i + 1) * pixels + (2 * j - factor) * new
        at = at.flatten()
        low = torch.div(at, 2 * new, rounding_mode="floor")
        offset = (torch.div((at - 2 * new * low) * _OFFSETS, 2 * new, rounding_mode="floor") + 0.5) / _OFFSETS
        ends = torch.stack([low, low + 1]).clamp(0, old - 1)
        return ends, torch.stack([1 - offset, offset]).double()

    (rows, down), (cols, across) = neighbours(height, labels.shape[-2]), neighbours(width, labels.shape[-1])
    corners = [labels.index_select(-2, r).index_select(-1, c) for r in rows for c in cols]
    sampled = corners[0].clone()
    # nearly everywhere the four are one label
    mixed = (corners[1] != sampled).logical_or_(corners[2] != sampled).logical_or_(corners[3] != sampled)
    at = mixed.nonzero(as_tuple=True)
    own = torch.stack([corner[at] for corner in corners])
    weights = torch.stack([d[at[-2]] * a[at[-1]] for d in down for a in across])
    scores = torch.stack([torch.where(own == corner, weights, 0.0).sum(0) for corner in own])
    sampled[at] = own.gather(0, scores.argmax(0, keepdim=True))[0]
    return sampled


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
