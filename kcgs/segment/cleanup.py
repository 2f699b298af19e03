"""Clean-up of labels: few connected regions, by decreasing area."""

import heapq
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcgs._check import check_count
from kcgs._labels import check_labels
from kcgs._repr import brief
from kcgs.compiled import threads_for_kernels
from kcgs.errors import InvalidArgument, InvalidArgumentType
from kcgs.maps import Labels, RegionGraph, compact, merge_nearest

from .images import check_segment_image, lab_sums, rgb_to_lab
from .snapping import snap_contours

# smallest region, as a share of the image: 600 pixels of 481 x 321
_MIN_SHARE = 0.004


@brief
class Segmentation(NamedTuple):
    """A label map, with a score and a name for every region if the method has scores and names."""

    labels: Tensor
    """:math:`(H, W)` int64, ids 0 to R - 1 by decreasing area."""
    scores: Tensor | None = None
    """:math:`(R,)` float32 in [0, 1], NaN for a region without a score; None: the method has no scores."""
    names: dict[int, str] | None = None
    """Names by id; several regions may have the same name. None: the method has no names."""


@brief
class Prediction(NamedTuple):
    """Labels of a method before clean-up, and scores per pixel; tensors or numpy arrays."""

    labels: Any
    """:math:`(H, W)`, integer or bool, non-negative."""
    scores: Any = None
    """:math:`(H, W)` in [0, 1], NaN for a pixel without a score; None: the method has no scores."""
    names: Sequence[str] | None = None
    """Names of the labels 0, 1, 2 and so on; None: the method has no names."""


@dataclass(frozen=True)
class Cleanup:
    """Options of the clean-up; its four steps have this order.

    Args:
        snap: pixels by which contours may move onto edges of the image; 0: they stay.
        min_size: 4-connected pieces of fewer pixels join the neighbour with the longest common border, the smallest
            piece first; at least 1, which keeps all pieces; None: 0.4 % of the image, at least sqrt(H W).
        connected: every 4-connected piece is a region of its own.
        max_regions: the two neighbours nearest in mean colour (CIE Lab) merge until at most this number of regions is
            left; None: all stay.

    Raises:
        TypeError, ValueError: an option has another type or is out of its range.
    """

    snap: int = 0
    min_size: int | None = None
    connected: bool = True
    max_regions: int | None = None

    def __post_init__(self) -> None:
        """Check the options before anything is loaded."""
        check_count("snap", self.snap, least=0)
        for name in ("min_size", "max_regions"):
            if getattr(self, name) is not None:
                check_count(name, getattr(self, name))
        if not isinstance(self.connected, bool):
            raise InvalidArgumentType("connected", "True or False", repr(self.connected))

    def min_pixels(self, num_pixels: int) -> int:
        """Return the least number of pixels of a region, for an image of `num_pixels`."""
        return self.min_size or max(round(_MIN_SHARE * num_pixels), round(math.sqrt(num_pixels)))

    def apply(self, image: Any, labels: Any) -> Segmentation:
        """Clean the labels of an image, or a `Prediction`.

        The score of a region is the mean over its pixels; its name is that of its most frequent label.

        Raises:
            TypeError, ValueError: no image; no labels or scores of its size; more labels than names.

        Example:
            >>> labels = torch.tensor([[3, 3, 3, 8], [3, 1, 3, 8]])
            >>> Cleanup(min_size=2).apply(torch.zeros(3, 2, 4), labels).labels.tolist()
            [[0, 0, 0, 1], [0, 0, 0, 1]]
        """
        pixels = check_segment_image(image)
        labels, scores, names = labels if isinstance(labels, Prediction) else Prediction(labels)
        classes = check_labels("labels", labels, dims=(2,)).cpu()
        scores = None if scores is None else torch.as_tensor(scores).detach().double().cpu()
        for name, values in (("labels", classes), ("scores", scores)):
            if values is not None and values.shape != pixels.shape[1:]:
                raise InvalidArgument(
                    name, f"the image's size {tuple(pixels.shape[1:])}", tuple(values.shape), verb="have"
                )
        if names is not None and int(classes.max()) >= len(names):
            raise InvalidArgument("names", f"one for label {int(classes.max())}", f"{len(names)} names", verb="have")
        with threads_for_kernels(classes.numel()):
            regions = self._clean(pixels, to_regions(classes.numpy()))
        return Segmentation(
            torch.from_numpy(regions).to(pixels.device),
            None if scores is None else _region_means(regions, scores.numpy()).to(pixels.device),
            None if names is None else _region_names(regions, classes.numpy(), names),
        )

    def _clean(self, image: Tensor, regions: Labels) -> Labels:
        if self.snap:
            regions = snap_contours(rgb_to_lab(image), regions, self.snap)
        regions = clean(regions, self.min_pixels(regions.size), connected=self.connected)
        return order_by_area(merge_similar(image, regions, self.max_regions))


def connect(labels: Labels) -> Labels:
    """Return the 4-connected pieces, numbered from 0 in raster order of their first pixels."""
    from skimage.measure import label

    return np.asarray(label(labels, background=-1, connectivity=1), dtype=np.int64) - 1


def to_regions(labels: Labels) -> Labels:
    """Renumber labels as 0 to R - 1, in their order."""
    return compact(torch.from_numpy(labels))[1].numpy().astype(np.int64)


def order_by_area(labels: Labels) -> Labels:
    """Renumber regions by decreasing area; of equal areas, the region with the earlier first pixel comes first."""
    regions = to_regions(labels)
    areas = np.bincount(regions.ravel())
    first = np.empty_like(areas)
    first[regions.ravel()[::-1]] = np.arange(regions.size)[::-1]  # of repeated indices the last one counts
    rank = np.empty_like(areas)
    rank[np.lexsort((first, -areas))] = np.arange(len(areas))
    return rank[regions]


def merge_small(labels: Labels, min_size: int, objects: Labels | None = None) -> Labels:
    """Merge every 4-connected piece under ``min_size`` pixels into the neighbour with the longest common border.

    The smallest piece is merged first, and a piece that reaches ``min_size`` by merging stays. Of neighbours with equal
    borders the larger takes the piece; of equally large neighbours, the one whose first pixel comes earlier. Other
    pieces keep their label. Pieces of different objects do not merge; labels must not cross the contours of objects.
    """
    pieces = connect(labels)
    graph = RegionGraph(pieces, objects)
    queue = [(int(area), piece) for piece, area in enumerate(graph.areas) if area < min_size]
    heapq.heapify(queue)
    while queue:
        area, piece = heapq.heappop(queue)
        borders = graph.borders[piece]
        if area != graph.areas[piece] or not borders:  # the piece has grown since, or is the whole image
            continue
        target = max(borders, key=lambda other: (borders[other], graph.areas[other], -other))
        graph.merge(piece, target)
        if graph.areas[target] < min_size:
            heapq.heappush(queue, (int(graph.areas[target]), target))
    label_of_piece = np.empty(len(graph.areas), dtype=np.int64)
    label_of_piece[pieces.ravel()] = labels.ravel()
    return label_of_piece[graph.roots()][pieces]


def merge_similar(image: Tensor, regions: Labels, max_regions: int | None, objects: Labels | None = None) -> Labels:
    """Merge the two neighbours nearest in mean colour until at most ``max_regions`` of the regions 0 to R - 1 are left.

    A merged region has the mean of all its pixels and the id of its largest part. Regions of different objects do not
    merge. None: all stay.
    """
    if max_regions is None or regions.max() < max_regions:
        return regions
    graph = RegionGraph(regions, objects)
    merge_nearest(graph, lab_sums(rgb_to_lab(image), regions), max_regions)
    return graph.roots()[regions]


def clean(labels: Labels, min_size: int, objects: Labels | None = None, *, connected: bool = True) -> Labels:
    """Return regions whose 4-connected pieces have at least ``min_size`` pixels, by decreasing area.

    With objects, regions are first divided along the contours of objects. Connected: each piece is a region.
    """
    if objects is not None:
        labels = labels * (int(objects.max()) + 1) + objects
    labels = merge_small(labels, min_size, objects)
    # connect after merging: a merged piece can join the two pieces of a region on its sides
    return order_by_area(connect(labels) if connected else labels)


def _region_means(regions: Labels, scores: NDArray[np.float64]) -> Tensor:
    has_score = np.isfinite(scores)
    count = int(regions.max()) + 1
    sums = np.bincount(regions[has_score], weights=scores[has_score], minlength=count)
    with np.errstate(invalid="ignore"):
        means = sums / np.bincount(regions[has_score], minlength=count)
    return torch.from_numpy(means).clamp(0, 1).float()


def _region_names(regions: Labels, classes: Labels, names: Sequence[str]) -> dict[int, str]:
    """Return the name of every region: the name of its most frequent class."""
    pairs = (regions * len(names) + classes).ravel()
    counts = np.bincount(pairs, minlength=(int(regions.max()) + 1) * len(names)).reshape(-1, len(names))
    return {region: names[label] for region, label in enumerate(counts.argmax(axis=1).tolist())}
