"""RegionMap: a label map made ready for rendering, and everything that is done to one."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcgs._check import check_labels, check_size
from kcgs.kernels import Crisp, Membership, Resampled

from .labels import compact, sample_labels, touching_pairs, union
from .map_tables import MapTables, keep_tables
from .softness import (
    CRISP_WIDTH,
    PairWidths,
    check_contours,
    check_softness,
    crisp_widths,
    is_crisp,
    merged_widths,
    scaled_widths,
    widths_of,
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class RegionMap:
    r"""A label map made ready for rendering: which region each pixel belongs to, and how sharply.

    Convention: ids are any non-negative integers. With ``softness`` 0 a pixel belongs to its label alone (the paper's
    rule). Above 0 the membership of region r is the blur of [M = r] by a Gaussian of that standard deviation, cut at
    4 standard deviations, normalised to sum to one: pixels farther than that from a contour are unchanged. With a
    width for each pair of regions a pixel is blurred by the width of its nearest contour. A map has a copy of the
    labels it was made from, and ``labels`` gives copies of that: whatever writes to them changes no render.

    Example:
        >>> regions = RegionMap.from_labels(torch.tensor([[3, 3, 7], [3, 7, 7]]))
        >>> regions.num_regions, regions.size, regions.softness
        (2, (2, 3), 0.0)
    """

    ids: Tensor  # (R,) int64, sorted
    softness: float | PairWidths = 0.0
    _labels: Tensor = field(repr=False, kw_only=True)
    tables: MapTables = field(repr=False, kw_only=True)
    widths: Tensor | None = field(repr=False, kw_only=True)  # softness, as the operator takes it
    _origin: RegionMap | None = field(default=None, repr=False, kw_only=True)  # what this was resized from

    def __post_init__(self) -> None:
        """Keep the tables where the operator finds them."""
        keep_tables(self._operator_labels, self.size, is_crisp(self.widths), self.tables)

    def __getstate__(self) -> dict[str, Any]:
        """Leave the tables of other sizes, which labels carry along, behind."""
        return {**vars(self), "_labels": self._labels.detach()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Keep the tables of a copy where the operator finds them, too."""
        vars(self).update(state)
        self.__post_init__()

    def __repr__(self) -> str:
        return f"RegionMap({self.num_regions} regions, size={self.size}, softness={self.softness})"

    @classmethod
    def from_labels(
        cls,
        labels: Tensor | NDArray[Any],
        softness: float | Mapping[tuple[int, int], float] = 0.0,
    ) -> RegionMap:
        r"""Build from a label map.

        Args:
            labels: integer or bool, a Tensor or a numpy array, :math:`(H, W)` or :math:`(B, H, W)`, non-negative; ids
                need not be consecutive.
            softness: contour width (standard deviation) in pixels, 0 to 64; or one for each pair of ids in any
                order, 0 for pairs that are not mentioned.

        Raises:
            TypeError: labels are no integers; softness of another type.
            ValueError: wrong shape, no pixels, negative ids, softness out of range or of ids that are not in the map.

        Example:
            >>> edge = torch.tensor([[1, 1, 1, 2], [1, 1, 1, 2]])
            >>> RegionMap.from_labels(edge, {(2, 1): 0.7}).softness
            0.7
        """
        with torch.inference_mode(False):  # a graph of autograd keeps no tensor of that mode
            labels = check_labels("labels", labels).clone()
        ids, index, table = compact(labels)
        width = check_softness(softness, ids)
        by_index: float | Mapping[tuple[int, int], float] = width
        if isinstance(width, PairWidths):
            position = {region: place for place, region in enumerate(ids.tolist())}
            by_index = {(position[a], position[b]): value for (a, b), value in width.items()}
        index = index if index.ndim == 3 else index[None]
        tables = MapTables(ids, table, Membership(index, len(ids), by_index))
        return cls(ids, width, _labels=labels, tables=tables, widths=widths_of(width, labels.device))

    @classmethod
    def coerce(cls, value: object, name: str = "regions") -> RegionMap | None:
        """Return a RegionMap, a label map's with hard contours, or None; TypeError calls anything else `name`."""
        if value is None or isinstance(value, RegionMap):
            return value
        if isinstance(value, Tensor | np.ndarray):
            return cls.from_labels(value)
        raise TypeError(f"{name} must be a RegionMap, a label map or None; got {type(value).__name__}")

    @property
    def labels(self) -> Tensor:
        """Label of each pixel, (H, W) or (B, H, W) int64, a copy."""
        return self._labels.clone()

    @property
    def _operator_labels(self) -> Tensor:
        """The map's own labels at its own resolution, which the operator takes and nobody writes to."""
        return self.given._labels

    @property
    def num_maps(self) -> int | None:
        """Number of maps of a batch, B; None: one map without a batch."""
        return self._labels.shape[0] if self._labels.ndim == 3 else None

    @property
    def num_regions(self) -> int:
        """Number of distinct ids."""
        return len(self.ids)

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        return self._labels.shape[-2], self._labels.shape[-1]

    @property
    def given(self) -> RegionMap:
        """The map that this one was interpolated from; itself where it was not."""
        return self if self._origin is None else self._origin

    @property
    def membership(self) -> Membership:
        """What the kernels evaluate."""
        return self.tables.membership

    @property
    def index(self) -> Tensor:
        """Position of each pixel's label among `ids`, (B, H, W) int32, also for one map."""
        return self.membership.index

    @property
    def resized(self) -> bool:
        """Whether these are memberships of another map's pixels, interpolated, or made crisp."""
        return self._origin is not None

    def index_of(self, region_ids: Tensor) -> Tensor:
        """Return the position of each id among `ids`, -1 where the map does not hold it."""
        return self.tables.index_of(region_ids)

    def weights(self, region_ids: int | Iterable[int], dtype: torch.dtype = torch.float64) -> Tensor:
        r"""Evaluate the membership of a region at every pixel, or the sum over several.

        Args:
            region_ids: an id, or several; ids that the map does not hold have no pixels.
            dtype: of the result; sums are taken in float64.

        Returns:
            :math:`(H, W)`, in [0, 1] up to rounding.

        Raises:
            ValueError: a batch of maps.

        Example:
            >>> regions = RegionMap.from_labels(torch.tensor([[3, 3, 7, 9]]))
            >>> regions.weights([3, 9])
            tensor([[1., 1., 0., 1.]], dtype=torch.float64)
        """
        if self.num_maps is not None:
            raise ValueError(f"weights needs one map; got a batch of {self.num_maps}")
        chosen = [region_ids] if isinstance(region_ids, int) else sorted(set(region_ids))
        places = self.index_of(torch.tensor(chosen, dtype=torch.int64, device=self.ids.device)).tolist()
        found = [self.membership.whole(0, place) for place in places if place >= 0]
        total = torch.zeros(self.size, dtype=torch.float64, device=self.ids.device)
        return (sum(found[1:], found[0]) if found else total).to(dtype)

    def relabel(
        self, labels: Tensor, new_width: float | Literal["mean"] | Mapping[tuple[int, int], float] = 0.0
    ) -> RegionMap:
        r"""Make the map of other labels, with the contour widths of this one.

        Where pairs of regions have widths, those of pairs whose ids are left stay.

        Args:
            labels: integer, the shape of `labels`.
            new_width: of pairs that touch in the new map, did not before, and have none: a number; "mean", of the
                widths that there are; or widths by pairs. Not read where one width holds for all.

        Raises:
            TypeError, ValueError: as :meth:`from_labels`; labels of another shape.

        Example:
            >>> regions = RegionMap.from_labels(torch.tensor([[1, 1, 2, 5]]), {(1, 2): 0.7})
            >>> regions.relabel(torch.tensor([[1, 5, 5, 2]]), "mean").softness
            PairWidths({(1, 2): 0.7, (1, 5): 0.7})
        """
        if labels.shape != self._labels.shape:
            raise ValueError(f"labels must have shape {tuple(self._labels.shape)}; got {tuple(labels.shape)}")
        softness: float | Mapping[tuple[int, int], float] = self.softness
        if isinstance(softness, PairWidths):
            softness = {**self._new_widths(labels, new_width), **softness}
        return self._with_labels(labels, softness)

    def _new_widths(
        self, labels: Tensor, width: float | Literal["mean"] | Mapping[tuple[int, int], float]
    ) -> Mapping[tuple[int, int], float]:
        assert isinstance(self.softness, PairWidths)
        if isinstance(width, Mapping) or width == 0.0:
            return width if isinstance(width, Mapping) else {}
        if width == "mean":
            width = sum(self.softness.values()) / len(self.softness)
        return dict.fromkeys(touching_pairs(labels) - touching_pairs(self._labels), width)

    def merge(self, pairs: Iterable[tuple[int, int]]) -> tuple[RegionMap | None, Tensor]:
        """Merge pairs of regions: to the least of their ids, and contours to the mean of the widths they are made of.

        Args:
            pairs: ids in the map.

        Returns:
            The map, None where one region is left, and the new id of each of `ids`, (R,).

        Raises:
            ValueError: an id that the map does not hold.

        Example:
            >>> regions, new_ids = RegionMap.from_labels(torch.tensor([[1, 4, 6]])).merge([(6, 4)])
            >>> regions.labels, new_ids
            (tensor([[1, 4, 4]]), tensor([1, 4, 4]))
        """
        find = union(self.ids.tolist(), pairs)
        new_ids = torch.tensor([find(region) for region in self.ids.tolist()], device=self.ids.device)
        if len(new_ids.unique()) == 1:
            return None, new_ids
        labels = new_ids[self.index_of(self._labels)]
        softness = merged_widths(self.softness, find)
        return RegionMap.from_labels(labels, softness), new_ids

    def to(self, device: torch.device | str) -> RegionMap:
        """Return the map on another device."""
        device = torch.device(device)
        if device == self.ids.device:
            return self
        moved = {name: part.to(device) for name, part in vars(self).items() if hasattr(part, "to")}
        return replace(self, **moved)

    def image(self, index: int | slice) -> RegionMap:
        """Copy one map of a batch, or a slice of it, with the regions that it has.

        Raises:
            ValueError: the map is not batched.
            IndexError: there is no such map.

        Example:
            >>> RegionMap.from_labels(torch.tensor([[[1, 4]], [[1, 1]]])).image(0).labels
            tensor([[1, 4]])
        """
        if self.num_maps is None:
            raise ValueError("image needs a batch of maps; got one map")
        if self._origin is not None:
            return self._origin.image(index).resize(self.size, self.contours)
        return self._with_labels(self._labels[index], self.softness)

    def _with_labels(self, labels: Tensor, widths: float | Mapping[tuple[int, int], float]) -> RegionMap:
        """Make the map of these labels, without the widths of pairs that they do not have."""
        if isinstance(widths, Mapping):
            left = set(labels.unique().tolist())
            widths = {pair: width for pair, width in widths.items() if left.issuperset(pair)}
        return RegionMap.from_labels(labels, widths)

    def state(self) -> dict[str, Any]:
        """Return what :meth:`from_state` makes the same map of: tensors, numbers, tuples and None only."""
        if self._origin is not None:
            return {**self._origin.state(), "size": self.size, "contours": self.contours}
        widths = self.softness if isinstance(self.softness, float) else tuple(self.softness.items())
        return {"labels": self.labels, "softness": widths, "size": self.size}

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> RegionMap:
        """Make the map that :meth:`state` describes."""
        widths = state["softness"]
        softness = widths if isinstance(widths, float) else {tuple(pair): width for pair, width in widths}
        return cls.from_labels(state["labels"], softness).resize(state["size"], state.get("contours", "scaled"))

    @property
    def contours(self) -> str:
        """How contours were resized: "scaled" or "crisp"."""
        return "crisp" if is_crisp(self.widths) else "scaled"

    def resize(self, size: tuple[int, int], contours: str = "scaled") -> RegionMap:
        """Sample the map at another resolution; contours are smoothed, not stepped.

        Hard contours stay hard: between pixel centres a point has the label with the largest share among its four
        neighbours (bilinear weights, of offsets rounded to odd multiples of 1/2048 pixel, so that no two labels tie).
        Labels that are left with no pixel are no regions.

        Soft contours widen along with the map: a point has the bilinear mean of its four neighbours' memberships. A
        larger map raises them to a power that takes out the blur of pixels, and makes them sum to one. All regions
        stay. The same size gives the same map. No means are taken in a smaller one; a renderer takes them of images.

        Crisp contours are about one pixel wide in the mean of both directions, at any size, the map's own too: a smooth
        curve that leaves the centres of the map's pixels on their side. ``softness`` is then 0.5.

        Args:
            size: (height, width).
            contours: scaled or crisp.

        Raises:
            TypeError, ValueError: not two positive integers; other contours.

        Example:
            >>> RegionMap.from_labels(torch.eye(3).long()).resize((6, 6)).labels[0]
            tensor([1, 1, 0, 0, 0, 0])
        """
        height, width = check_size("size", size)
        crisp = check_contours(contours) == "crisp" and self.num_regions > 1
        if crisp == (self.contours == "crisp") and (height, width) == self.size:
            return self
        if self._origin is not None:
            return self._origin.resize((height, width), contours)
        if not crisp and self.softness == 0.0:
            sampled = RegionMap.from_labels(sample_labels(self._labels, height, width))
            return replace(sampled, tables=sampled.tables._replace(whole=False))
        labels = sample_labels(self._labels, height, width)
        index = self.index_of(labels).to(torch.int32)
        membership = (Crisp if crisp else Resampled)(index if index.ndim == 3 else index[None], self.membership)
        widened = scaled_widths(self.softness, math.sqrt(height * width / (self.size[0] * self.size[1])))
        return RegionMap(
            self.ids, CRISP_WIDTH if crisp else widened, _labels=labels, _origin=self,
            widths=crisp_widths(labels.device) if crisp else self.widths,
            tables=self.tables._replace(membership=membership),
        )  # fmt: skip
