"""Contours that move: each pixel near a contour goes to the region whose own Gaussians explain it best.

With the descent on the Gaussians this is alternating minimisation of a Mumford-Shah energy whose smooth part is a sum
of Gaussians for each region.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcgs._check import check_image, check_labels
from kcgs.functional import RegionMap, edge_band
from kcgs.nn import GaussianField

from .contours import Contours, Costs, bounding_boxes, index_map, unequal

Ints = NDArray[np.int64]
Labels = NDArray[np.int32]
Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


@torch.no_grad()
def refine_contours(
    field: GaussianField,
    image: Tensor,
    regions: RegionMap,
    *,
    given: Tensor | None = None,
    max_distance: float | None = 3.0,
    length_weight: float = 0.003,
    reach: int = 2,
    sweeps: int = 3,
    blur: float = 0.7,
    smallest: int = 12,
    cutoff: float = 1e-4,
    backend: str = "auto",
) -> RegionMap:
    r"""Move contours to where the picture is explained better, at most `max_distance` from the given map.

    Lowers the energy of :func:`contour_energy` by exact coordinate descent: all pixels of one colour of a 2 x 2
    colouring at once, which no two 8-neighbours share, so that no sweep raises it. Then 4-connected pieces under
    `smallest` pixels that came up on the way are given to the adjacent label that costs least (a piece that continues
    one that was that small before stays, and so does one that no adjacent label may take).

    Convention: no region is lost. Each keeps min(its pixels, `smallest`) pixels: in the sweeps that many of those
    farthest from its contour are held, and no piece is given away that would leave fewer. Deterministic.

    Args:
        field: unbatched, with region ids.
        image: :math:`(C, H, W)`, floating, of the field's size and channels.
        regions: one map of that size; the field's ids refer to it.
        given: the map that distances are taken from, integer :math:`(H, W)`; None: `regions`. Hand in the first map at
            each call, and no number of calls moves a contour farther.
        max_distance: pixels, at least 1: a pixel may get only a label that `given` has within this distance of it;
            None: no bound. The time grows with its square: for a few pixels.
        length_weight: squared error that a pixel of contour must save, at least 0. A pixel alone among others pays 2
            of it, a straight contour 0.75 a pixel.
        reach: pixels, at least 1: in each sweep a pixel may get only a label that is within this distance of it.
        sweeps: at least 1.
        blur: standard deviation in pixels of the blur of the squared error, 0 to 16.
        smallest: pixels, at least 1; 1 absorbs nothing.
        cutoff: as in :func:`kcgs.functional.region_splat`.
        backend: as there.

    Returns:
        The refined map with the softness of `regions`; where that is given by pairs of ids, pairs that newly touch get
        the mean width. `regions` itself where nothing lowers the energy.

    Raises:
        TypeError: arguments of the wrong type.
        ValueError: batched or supersampled maps, a batched field or one without ids, sizes or channels that do not
            fit, numbers out of range.

    Example:
        >>> image = torch.zeros(1, 8, 16)
        >>> image[..., 8:] = 1.0
        >>> regions = RegionMap.from_labels((torch.arange(16) >= 6).long().expand(8, 16))
        >>> means, factors = torch.tensor([[4.0, 4.0], [12.0, 4.0]]), torch.tensor([[99.0, 0.0, 99.0]]).repeat(2, 1)
        >>> field = GaussianField(means, factors, torch.tensor([[0.0], [1.0]]), torch.tensor([0, 1]), size=(8, 16))
        >>> refine_contours(field, image, regions).labels[0].tolist()
        [0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 1, 1, 1, 1]

    Source: Mumford and Shah's functional of 1989; Besag's iterated conditional modes of 1986.
    """
    _check_problem(field, image, regions)
    _check_numbers(
        {"length_weight": length_weight, "blur": blur, "max_distance": 1 if max_distance is None else max_distance}
    )
    _check_counts({"reach": reach, "sweeps": sweeps, "smallest": smallest})
    given = regions.labels if given is None else check_labels("given", given).to(regions.labels.device)
    if given.shape != regions.labels.shape:
        raise ValueError(f"given must have the shape {tuple(regions.labels.shape)}; got {tuple(given.shape)}")
    if regions.num_regions == 1:
        return regions
    index = index_map(regions, regions.labels)
    distance = min(1 if max_distance is None else max_distance, math.hypot(*index.shape))
    pad = max(reach, int(distance))
    rim = edge_band(torch.from_numpy(index), 1).numpy()
    boxes = bounding_boxes(np.where(rim, index, -1), regions.num_regions, reach * sweeps + smallest)
    costs = Costs(field, image, regions, boxes, pad, blur, cutoff=cutoff, backend=backend)
    contours = Contours(index, costs, length_weight, pad, smallest)
    contours.hold(rim, reach * sweeps)
    if max_distance is not None:
        contours.bound(index_map(regions, given), distance)
    for _ in range(sweeps):
        if not contours.sweep(reach):
            break
    while contours.absorb():
        pass
    if not contours.change() < 0:
        return regions
    labels = regions.ids.cpu()[torch.from_numpy(contours.map).long()].to(regions.labels.device)
    return RegionMap.from_labels(labels, _softness(regions, labels))


def accept_moves(before: RegionMap, after: RegionMap, gain: Tensor) -> RegionMap:
    """Keep, of the moves between two maps, those whose own surroundings are drawn better.

    Moves are judged by the region's Gaussians alone; the picture blends them over soft contours. Pixels that changed
    hands are grouped with all within two pixels, and a group stays changed where the gain is positive in its sum.

    Args:
        before: the map that moved.
        after: what it became, with the same regions.
        gain: squared error of the picture drawn with `before`, or what else it may be, minus that with `after`, (H, W).

    Returns:
        A map; `before` where nothing is kept, or a region would be lost.

    Example:
        >>> maps = [RegionMap.from_labels((torch.arange(9) > k).long().expand(6, 9)) for k in (3, 4)]
        >>> accept_moves(*maps, -torch.ones(6, 9)) is maps[0]
        True
    """
    from scipy import ndimage

    changed = (before.labels != after.labels).cpu().numpy()
    groups, count = ndimage.label(ndimage.binary_dilation(changed, iterations=2), np.ones((3, 3)))
    sums = ndimage.sum_labels(gain.double().cpu().numpy(), groups, np.arange(1, count + 1))
    kept = torch.from_numpy(np.concatenate([[False], sums > 0])[groups]).to(before.labels.device)
    labels = torch.where(kept, after.labels, before.labels)
    if not bool(kept.any()) or len(torch.unique(labels)) < before.num_regions:
        return before
    return RegionMap.from_labels(labels, _softness(after, labels))


@torch.no_grad()
def contour_energy(
    field: GaussianField,
    image: Tensor,
    regions: RegionMap,
    *,
    length_weight: float = 0.003,
    blur: float = 0.7,
    cutoff: float = 1e-4,
    backend: str = "auto",
) -> float:
    r"""Say what :func:`refine_contours` lowers.

    .. math:: E = \sum_p (G * |I - F_{l(p)}|^2)(p) + \beta \sum_p \tfrac18 |\{q \in N_8(p): l(q) \ne l(p)\}|

    F_r is the sum of region r's Gaussians without the constraint, the square is the mean over channels, G the blur,
    normalised at the image's borders; beyond them there are no neighbours.

    Args:
        field: this and the others as in :func:`refine_contours`.
        image: :math:`(C, H, W)`.
        regions: one map.
        length_weight: beta, the squared error that a pixel of contour must save.
        blur: standard deviation of G in pixels.
        cutoff: as in :func:`kcgs.functional.region_splat`.
        backend: as there.

    Returns:
        Squared error, summed over pixels.

    Raises:
        TypeError, ValueError: as :func:`refine_contours`.

    Example:
        >>> field = GaussianField(torch.ones(1, 2), torch.tensor([[9.0, 0.0, 9.0]]), torch.zeros(1, 1),
        ...                       torch.tensor([0]), size=(2, 2))
        >>> regions = RegionMap.from_labels(torch.tensor([[0, 0], [0, 1]]))
        >>> round(contour_energy(field, torch.full((1, 2, 2), 0.5), regions, length_weight=0.4), 4)
        1.3

    Source: Mumford and Shah, "Optimal approximations by piecewise smooth functions", 1989.
    """
    _check_problem(field, image, regions)
    _check_numbers({"length_weight": length_weight, "blur": blur})
    index = index_map(regions, regions.labels)
    boxes = bounding_boxes(index, regions.num_regions, 0)
    costs = Costs(field, image, regions, boxes, 0, blur, cutoff=cutoff, backend=backend)
    data = costs.at(np.arange(index.size), index.ravel()).sum()
    return float(data) + length_weight / 4 * unequal(np.pad(index, 1, constant_values=-1))


def _check_problem(field: GaussianField, image: Tensor, regions: RegionMap) -> None:
    if not isinstance(field, GaussianField):
        raise TypeError(f"field must be a GaussianField; got {type(field).__name__}")
    if field.means.ndim != 2 or field.region_ids is None:
        raise ValueError(f"field must be unbatched with region_ids; got means of shape {tuple(field.means.shape)}")
    check_image("image", image)
    if tuple(image.shape) != (field.colors.shape[-1], *field.size):
        raise ValueError(
            f"image must have the field's shape {(field.colors.shape[-1], *field.size)}; got {tuple(image.shape)}"
        )
    if not isinstance(regions, RegionMap):
        raise TypeError(f"regions must be a RegionMap; got {type(regions).__name__}")
    if regions.labels.ndim != 2 or regions.size != field.size:
        raise ValueError(f"regions must be one map of size {field.size}; got {tuple(regions.labels.shape)}")
    if regions.supersample > 1:
        raise ValueError(f"regions must have one label a pixel; got supersample {regions.supersample}")


def _check_counts(counts: dict[str, int]) -> None:
    for name, count in counts.items():
        if isinstance(count, bool) or not isinstance(count, int):
            raise TypeError(f"{name} must be an integer; got {count!r}")
        if count < 1:
            raise ValueError(f"{name} must be at least 1; got {count}")


def _check_numbers(values: dict[str, float]) -> None:
    ranges = {"length_weight": (0.0, 1e9), "blur": (0.0, 16.0), "max_distance": (1.0, 1e9)}
    for name, value in values.items():
        low, high = ranges[name]
        if not low <= value <= high:
            raise ValueError(f"{name} must be in [{low:g}, {high:g}]; got {value!r}")


def _softness(regions: RegionMap, labels: Tensor) -> float | Mapping[tuple[int, int], float]:
    """Return the width of contours for the new map; where pairs have their own, newly touching ones get the mean."""
    widths = regions.softness
    if not isinstance(widths, Mapping):
        return widths
    mean = sum(widths.values()) / len(widths)
    fresh = _touching(labels) - _touching(regions.labels) - {*widths}
    return {**widths, **dict.fromkeys(fresh, mean)}


def _touching(labels: Tensor) -> set[tuple[int, int]]:
    """Return the pairs of ids, the lower first, that have a pixel's side in common."""
    sides = ((labels[:, 1:], labels[:, :-1]), (labels[1:], labels[:-1]))
    pairs = torch.cat([torch.stack([a[a != b], b[a != b]], 1) for a, b in sides])
    return {(a, b) for a, b in pairs.sort(1).values.unique(dim=0).tolist()}
