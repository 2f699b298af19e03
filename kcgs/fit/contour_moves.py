"""Contours that move: each pixel near a contour goes to the region whose own Gaussians explain it best.

With the descent on the Gaussians this is alternating minimisation of a Mumford-Shah energy whose smooth part is a sum
of Gaussians for each region.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from kcgs.functional import RegionMap, edge_band
from kcgs.scene import Scene

from .colors import check_scene
from .contour_energy import MovingLabels, RegionCosts, bounding_boxes, index_map


@torch.no_grad()
def refine_contours(
    scene: Scene,
    image: Tensor,
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
    r"""Move contours to where the image is explained better, at most `max_distance` from the given map.

    Lowers, by exact coordinate descent, the energy

    .. math:: E = \sum_p (G * |I - F_{l(p)}|^2)(p) + \beta \sum_p \tfrac18 |\{q \in N_8(p): l(q) \ne l(p)\}|

    F_r is the sum of region r's Gaussians without the constraint, the square is the mean over channels, G the blur,
    normalised at the image's borders; beyond them there are no neighbours. All pixels of one colour of a 2 x 2
    colouring move at once, which no two 8-neighbours share, so that no sweep raises the energy. Then 4-connected
    pieces under `smallest` pixels that came up on the way are given to the adjacent label that costs least (a piece
    that continues one that was that small before stays, and so does one that no adjacent label may take).

    Convention: no region is lost. Each keeps min(its pixels, `smallest`) pixels: in the sweeps that many of those
    farthest from its contour stay, and no piece is given away that would leave fewer. Deterministic.

    Args:
        scene: Gaussians of one image, with one map that is not supersampled.
        image: :math:`(C, H, W)`, floating, of the scene's size and channels.
        given: the map that distances are taken from, integer :math:`(H, W)`; None: the scene's. Hand in the first map
            at each call, and no number of calls moves a contour farther.
        max_distance: pixels, at least 1: a pixel may get only a label that `given` has within this distance of it;
            None: no bound. The time grows with its square: for a few pixels.
        length_weight: beta, the squared error that a pixel of contour must save, at least 0. A pixel alone among others
            costs 2 of it, a straight contour 0.75 per pixel.
        reach: pixels, at least 1: in each sweep a pixel may get only a label that is within this distance of it.
        sweeps: at least 1.
        blur: standard deviation in pixels of the blur of the squared error, 0 to 16.
        smallest: pixels, at least 1; 1: no piece is given away.
        cutoff: as in :func:`kcgs.functional.region_splat`.
        backend: as there.

    Returns:
        The refined map with the softness of the scene's; where that is given by pairs of ids, pairs that newly touch
        get the mean width. The scene's map itself where nothing lowers the energy.

    Raises:
        TypeError, ValueError: as :func:`kcgs.fit.colors.check_scene`.

    Example:
        >>> image = torch.zeros(1, 8, 16)
        >>> image[..., 8:] = 1.0
        >>> regions = RegionMap.from_labels((torch.arange(16) >= 6).long().expand(8, 16))
        >>> from kcgs import GaussianField
        >>> means, factors = torch.tensor([[4.0, 4.0], [12.0, 4.0]]), torch.tensor([[99.0, 0.0, 99.0]]).repeat(2, 1)
        >>> field = GaussianField(means, factors, torch.tensor([[0.0], [1.0]]), torch.tensor([0, 1]), size=(8, 16))
        >>> refine_contours(Scene(field, regions), image).labels[0].tolist()
        [0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 1, 1, 1, 1]

    Source: Mumford and Shah's functional of 1989; Besag's iterated conditional modes of 1986.
    """
    check_scene(scene, image)
    regions = scene.regions
    assert regions is not None and regions.supersample == 1
    given = regions.labels if given is None else given
    if regions.num_regions == 1:
        return regions
    index = index_map(regions, regions.labels)
    distance = min(1 if max_distance is None else max_distance, math.hypot(*index.shape))
    pad = max(reach, int(distance))
    rim = edge_band(torch.from_numpy(index), 1).numpy()
    boxes = bounding_boxes(np.where(rim, index, -1), regions.num_regions, reach * sweeps + smallest)
    costs = RegionCosts(scene, image, boxes, pad, blur, cutoff=cutoff, backend=backend)
    moving = MovingLabels(index, costs, length_weight, pad, smallest)
    moving.fix_cores(rim, reach * sweeps)
    if max_distance is not None:
        moving.bound(index_map(regions, given), distance)
    for _ in range(sweeps):
        if not moving.sweep(reach):
            break
    while moving.give_away_pieces():
        pass
    if not moving.change() < 0:
        return regions
    labels = regions.ids.cpu()[torch.from_numpy(moving.map).long()].to(regions.labels.device)
    return regions.relabel(labels, "mean")


def accept_moves(before: RegionMap, after: RegionMap, gain: Tensor) -> RegionMap:
    """Keep, of the moves between two maps, those whose surroundings are rendered better.

    Moves are judged by the region's Gaussians alone; the render blends them over soft contours. Pixels that changed
    their label are grouped with all within two pixels, and a group stays changed where the gain is positive in its sum.

    Args:
        before: the map that moved.
        after: what it became, with the same regions.
        gain: squared error of the render with `before`, or what else it may be, minus that with `after`, (H, W).

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
    return after.relabel(labels, "mean")
