"""RegionMap: a label map made ready for rendering, and the operations on it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal

import torch
from torch import Tensor

from kcgs._check import check_integer, check_size
from kcgs._labels import check_labels
from kcgs.errors import InvalidArgument

from .derived import table_at
from .labels import positions_of, sample_labels, union_find
from .softness import (
    GivenSoftness,
    Softness,
    extended_softness,
    for_each,
    merged_softness,
    scaled_softness,
    softness_from_plain,
    softness_of_labels,
    softness_to_plain,
)
from .table import MapTable, full_map
from .table_of_labels import table_of_labels


class RegionMap:
    r"""A label map made ready for rendering: which region each pixel belongs to, and how soft contours are.

    Convention: ids are any non-negative integers. With ``softness`` 0 a pixel belongs to its label alone (the paper's
    rule). Above 0 the membership of region r is the blur of [M = r] by a Gaussian of that standard deviation, cut at
    4 standard deviations, normalised to sum to one: pixels farther than that from a contour are unchanged. With a
    softness for each pair of regions a pixel is blurred by the softness of its nearest contour. A map copies its
    labels, and ``labels`` returns a copy: to write to either changes no render.

    Example:
        >>> regions = RegionMap(torch.tensor([[3, 3, 7], [3, 7, 7]]))
        >>> regions.num_regions, regions.size, regions.softness
        (2, (2, 3), 0.0)
    """

    def __init__(self, labels: Any, softness: GivenSoftness = 0.0) -> None:
        r"""Make a map of labels.

        Args:
            labels: integer or bool, or floating with whole numbers, a Tensor or a numpy array, :math:`(H, W)`,
                :math:`(B, H, W)` or :math:`(B, 1, H, W)`, non-negative; ids need not be consecutive. Or a PIL image, or
                the path of a file that :func:`kcgs.data.load_labels` reads.
            softness: of contours (standard deviation) in pixels, 0 to 64; or one for each pair of ids in any order, 0
                for pairs that are not mentioned. For a batch also a list with either for each map.

        Raises:
            TypeError: labels are no integers; softness of another type.
            ValueError: wrong shape, no pixels, negative ids, softness out of range, of ids that are not in the map, or
                of another number of maps; a grey image or array with soft edges, for which the message has a threshold.

        Example:
            >>> edge = torch.tensor([[1, 1, 1, 2], [1, 1, 1, 2]])
            >>> RegionMap(edge, {(2, 1): 0.7}).softness
            0.7
        """
        with torch.inference_mode(False):  # autograd saves no tensor of inference mode
            self._fill(*table_of_labels(check_labels("labels", labels).clone(), softness))

    def _fill(self, table: MapTable, softness: Softness) -> RegionMap:
        """Take a table at its own size; return the map."""
        assert table.positions is not None
        self._labels, self._index, self._softness = table.labels, table.positions, softness
        self._table = table  # that of the source, where there is one
        self._source: RegionMap | None = None  # the map that a resized map interpolates
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle no derived tensors: torch moves the memory of each tensor that it sends to another process."""
        labels = self._labels if self._source is None else self._source._labels
        return RegionMap.from_state, ({**self.state(), "labels": labels},)

    def __deepcopy__(self, memo: dict[int, Any]) -> RegionMap:
        """Return the map itself: it is immutable."""
        return self

    def __repr__(self) -> str:
        return f"RegionMap({self.num_regions} regions, size={self.size}, softness={self.softness})"

    @classmethod
    def from_labels(cls, labels: Any, softness: GivenSoftness = 0.0) -> RegionMap:
        """Return RegionMap(labels, softness)."""
        return cls(labels, softness)

    @property
    def labels(self) -> Tensor:
        """Label of each pixel, (H, W) or (B, H, W) int64, a copy."""
        return self._labels.clone()

    @property
    def ids(self) -> Tensor:
        """The distinct ids, (R,) int64, sorted; the map's own, not to be written to."""
        assert self._table.ids is not None
        return self._table.ids

    @property
    def softness(self) -> Softness:
        """Softness of all contours in pixels, or of each pair of regions; a tuple where maps of a batch differ."""
        return self._softness

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
    def device(self) -> torch.device:
        """Where its tensors are."""
        return self._labels.device

    @property
    def index(self) -> Tensor:
        """Position of each pixel's label among `ids`, (B, H, W) int32, also for one map; not to be written to."""
        return self._index

    @property
    def is_resampled(self) -> bool:
        """True if `resize` made this map: it interpolates another one."""
        return self._source is not None

    def index_of(self, region_ids: Tensor) -> Tensor:
        """Return the position of each id, integers, among `ids`, -1 where the map does not hold it."""
        return positions_of(check_integer("region_ids", region_ids), self.ids)

    def membership(self, region_ids: int | Iterable[int] | Tensor, dtype: torch.dtype = torch.float64) -> Tensor:
        r"""Evaluate the membership of every pixel in a region, or the sum over several.

        Args:
            region_ids: an id, or several; ids that the map does not hold have no pixels.
            dtype: of the result.

        Returns:
            :math:`(H, W)`, in [0, 1] up to rounding.

        Raises:
            TypeError: ids that are no integers.
            ValueError: a batch of maps.

        Example:
            >>> regions = RegionMap(torch.tensor([[3, 3, 7, 9]]))
            >>> regions.membership([3, 9])
            tensor([[1., 1., 0., 1.]], dtype=torch.float64)
        """
        if self.num_maps is not None:
            raise ValueError(f"membership needs one map; got a batch of {self.num_maps}")
        if not isinstance(region_ids, Tensor):
            several = [*region_ids] if isinstance(region_ids, Iterable) else [region_ids]
            region_ids = torch.tensor(several) if several else self.ids[:0]
        places = self.index_of(region_ids.flatten().unique().to(self.ids.device)).tolist()
        table = table_at(self._table, self.size)
        black = torch.zeros(self.size, dtype=torch.float64, device=self.ids.device)
        return sum((full_map(table, 0, place) for place in places if place >= 0), black).to(dtype)

    @classmethod
    def stack(cls, maps: Sequence[RegionMap]) -> RegionMap:
        """Make a batch of maps of one image each; each keeps its softness, and ``batch[k]`` returns map k.

        Args:
            maps: at least one, all of one size; resized maps also of one size before.

        Raises:
            ValueError: no maps, batches, or maps of several sizes, now or before they were resized.

        Example:
            >>> batch = RegionMap.stack([RegionMap(torch.tensor([[1, 2]]), 0.5), RegionMap(torch.tensor([[7, 7]]))])
            >>> batch.labels.shape, batch.softness
            (torch.Size([2, 1, 2]), (0.5, 0.0))
        """
        sources = [one._source or one for one in maps]
        sizes = {(one.num_maps, one.size, source.size) for one, source in zip(maps, sources, strict=True)}
        if len(sizes) != 1 or maps[0].num_maps is not None:
            expected = "at least one, each of one image, all of one size and resized from one size"
            raise InvalidArgument("maps", expected, sizes or "none")
        softness: Any = [one._softness for one in sources]
        return cls(torch.stack([one._labels for one in sources]), softness).resize(maps[0].size)

    def relabel(self, labels: Tensor, new_contours: Literal["hard", "mean"] = "hard") -> RegionMap:
        r"""Make the map of other labels, with the softness of this map; pairs whose ids remain keep theirs.

        Args:
            labels: integer, the shape of `labels`; the contours are those of these labels, also for a resized map.
            new_contours: softness of pairs that touch only in the new map and have none: 0 ("hard"), or the mean over
                all pairs ("mean"). Ignored where all contours have one softness.

        Raises:
            TypeError, ValueError: as the constructor; labels of another shape; another `new_contours`.

        Example:
            >>> regions = RegionMap(torch.tensor([[1, 1, 2, 5]]), {(1, 2): 0.7})
            >>> regions.relabel(torch.tensor([[1, 5, 5, 2]]), "mean").softness
            PairSoftness({(1, 2): 0.7, (1, 5): 0.7})
        """
        labels = check_labels("labels", labels)
        if labels.shape != self._labels.shape:
            raise InvalidArgument("labels", f"shape {tuple(self._labels.shape)}", tuple(labels.shape), verb="have")
        if new_contours not in ("hard", "mean"):
            raise InvalidArgument("new_contours", "'hard' or 'mean'", repr(new_contours))
        if not self._labels.is_cpu:  # the host would wait for the device at every step
            return self.to("cpu").relabel(labels.cpu(), new_contours).to(self._labels.device)
        softness: Any = self._softness
        if new_contours == "mean":
            softness = for_each(softness, extended_softness, labels, self._labels)
        return self._with_labels(labels, softness)

    def merge(self, pairs: Iterable[tuple[int, int]]) -> tuple[RegionMap | None, Tensor]:
        """Merge pairs of regions to the least of their ids; contours that become one have their mean softness.

        Args:
            pairs: ids in the map.

        Returns:
            The map, None where one region remains, and the new id of each of `ids`, (R,).

        Raises:
            ValueError: an id that the map does not hold.

        Example:
            >>> regions, new_ids = RegionMap(torch.tensor([[1, 4, 6]])).merge([(6, 4)])
            >>> regions.labels, new_ids
            (tensor([[1, 4, 4]]), tensor([1, 4, 4]))
        """
        if self._source is not None:
            merged, new_ids = self._source.merge(pairs)
            return merged and merged.resize(self.size), new_ids
        merged_id = union_find(self.ids.tolist(), pairs)
        new_ids = torch.tensor([merged_id(region) for region in self.ids.tolist()], device=self.ids.device)
        if len(new_ids.unique()) == 1:
            return None, new_ids
        labels = new_ids[self.index_of(self._labels)]
        return RegionMap(labels, for_each(self._softness, lambda one: merged_softness(one, merged_id))), new_ids

    def to(self, device: torch.device | str) -> RegionMap:
        """Return the map on another device."""
        return self if torch.device(device) == self.device else self._with_tensors(lambda tensor: tensor.to(device))

    def cuda(self) -> RegionMap:
        """Return the map on the current CUDA device."""
        return self._with_tensors(Tensor.cuda)

    def pin_memory(self) -> RegionMap:
        """Return the map in page-locked memory; a DataLoader with ``pin_memory=True`` calls this."""
        return self._with_tensors(Tensor.pin_memory)

    def _with_tensors(self, function: Callable[[Tensor], Tensor]) -> RegionMap:
        """Return the map with a function applied to each of its tensors."""
        if self._source is not None:
            return self._source._with_tensors(function).resize(self.size)
        return RegionMap.__new__(RegionMap)._fill(self._table.apply(function), self._softness)

    def __getitem__(self, index: int | slice) -> RegionMap:
        """Copy one map of a batch, or a slice of the batch, with only the regions that occur in it.

        Raises:
            ValueError: the map is not batched.
            IndexError: there is no such map.

        Example:
            >>> RegionMap(torch.tensor([[[1, 4]], [[1, 1]]]))[0].labels
            tensor([[1, 4]])
        """
        if self.num_maps is None:
            raise ValueError("an index needs a batch of maps; got one map")
        if self._source is not None:
            return self._source[index].resize(self.size)
        softness = self._softness[index] if isinstance(self._softness, tuple) else self._softness
        return self._with_labels(self._labels[index], softness)

    @staticmethod
    def _with_labels(labels: Tensor, softness: Any) -> RegionMap:
        """Make the map of these labels; the softness of pairs that they do not hold is dropped."""
        return RegionMap(labels, for_each(softness, softness_of_labels, labels))

    def state(self) -> dict[str, Any]:
        """Return the map as tensors, numbers and tuples, which ``torch.load(weights_only=True)`` reads.

        Example:
            >>> RegionMap(torch.tensor([[1, 2]])).state()
            {'labels': tensor([[1, 2]]), 'softness': 0.0, 'size': (1, 2)}
        """
        if self._source is not None:
            return {**self._source.state(), "size": self.size}
        return {"labels": self.labels, "softness": softness_to_plain(self._softness), "size": self.size}

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> RegionMap:
        """Return the map that :meth:`state` describes, on the device of its labels.

        Example:
            >>> RegionMap.from_state(RegionMap(torch.tensor([[1, 2]])).state())
            RegionMap(2 regions, size=(1, 2), softness=0.0)
        """
        return cls(state["labels"], softness_from_plain(state["softness"])).resize(state["size"])

    def resize(self, size: tuple[int, int]) -> RegionMap:
        r"""Sample the map at another resolution; contours are smooth curves, not stairs.

        A contour has the blur of the fitted contour, less the blur of the map's pixels, enlarged, plus the blur of a
        pixel of the new map: sharp contours stay sharp, soft contours stay soft. ``softness`` is the blur of the new
        contour. All regions remain, and lines one pixel wide stay about that wide; ``labels`` are those of the nearest
        pixels. The same size gives the same map. A smaller map takes no area means: the renderer takes them of the
        image. docs/concepts.md has the formula.

        Args:
            size: (height, width).

        Raises:
            TypeError, ValueError: not two positive integers.

        Example:
            >>> large = RegionMap(torch.eye(3).long()).resize((6, 6))
            >>> large.labels[0], large.softness
            (tensor([1, 1, 0, 0, 0, 0]), 0.5)
        """
        height, width = check_size("size", size)
        if (height, width) == self.size:
            return self
        if self._source is not None:
            return self._source.resize((height, width))
        ratio = height * width / (self.size[0] * self.size[1])
        softness = for_each(self._softness, lambda one: scaled_softness(one, ratio))
        regions = RegionMap.__new__(RegionMap)._fill(self._table, softness)
        regions._labels, regions._index = (sample_labels(t, height, width) for t in (self._labels, self._index))
        regions._source = self
        return regions


def wrap_labels(labels: Tensor, softness: GivenSoftness) -> RegionMap:
    """Make the map of valid int64 labels without a copy; the caller must not write to them."""
    return RegionMap.__new__(RegionMap)._fill(*table_of_labels(labels, softness))
