"""Contours that move: each pixel near a contour goes to the region whose own Gaussians explain it best."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from kcgs.maps import RegionMap, edge_band
from kcgs.optim import Gaussians, Renderer
from kcgs.scene import Scene

from .config import FitConfig


@torch.no_grad()
def refine_contours(
    scene: Scene,
    image: Tensor,
    *,
    anchor: Tensor | None = None,
    max_distance: float | None = 3.0,
    length_weight: float = 0.003,
    reach: int = 2,
    sweeps: int = 3,
    blur: float = 0.7,
    smallest: int = 12,
    backend: str = "auto",
) -> RegionMap:
    """Move contours where this lowers their energy, at most `max_distance` pixels from the map `anchor`.

    The method is exact coordinate descent on the energy in docs/method.md; no region is lost. Pieces under `smallest`
    pixels that moves have made are merged into the adjacent label that costs least. The result is on the CPU. If no
    move lowers the energy, it is the scene's own map.

    Source: Mumford and Shah's functional of 1989; Besag's iterated conditional modes of 1986.
    """
    from .contour_energy import MovingLabels, bounding_boxes, index_map, region_costs  # loads numba

    assert scene.regions is not None
    regions = scene.regions.to("cpu")
    if regions.num_regions == 1:
        return scene.regions
    index = regions.index[0].numpy()
    distance = min(1 if max_distance is None else max_distance, math.hypot(*index.shape))
    pad = 2 * math.ceil(max(reach, distance, 2) / 2)  # even: with the rim, rows and columns keep their parity
    rim = edge_band(torch.from_numpy(index), 1).numpy()
    boxes = bounding_boxes(np.where(rim, index, -1), regions.num_regions, reach * sweeps + smallest)
    costs = region_costs(scene, image, boxes, pad, blur, backend)
    moving = MovingLabels(index, costs, length_weight, pad, smallest)
    moving.fix_cores(rim, reach * sweeps)
    if max_distance is not None:
        moving.limit_moves(index if anchor is None else index_map(regions, anchor.cpu()), distance)
    for _ in range(sweeps):
        if not moving.sweep(reach):
            break
    while moving.merge_pieces():
        pass
    if not moving.energy_change() < 0:
        return scene.regions
    return regions.relabel(regions.ids[torch.from_numpy(moving.map).long()], "mean")


def move_contours(
    gaussians: Gaussians, renderer: Renderer, image: Tensor, anchor: Tensor, config: FitConfig, max_rise: float
) -> RegionMap:
    """Refine the contours of a map, and accept the moves that raise the squared error around them little enough.

    Args:
        gaussians: of one image.
        renderer: with the map.
        image: (C, H, W).
        anchor: labels (H, W) that contours may not move far from.
        config: has the largest move and the cost of a pixel of contour.
        max_rise: factor by which a move may raise the squared error.
    """
    regions = renderer.regions
    assert regions is not None

    def squared_error(regions: RegionMap) -> Tensor:
        return renderer._replace(regions=regions).squared_error(gaussians, image)

    scene = Scene(gaussians.field(renderer.size), regions)
    proposal = refine_contours(
        scene, image, anchor=anchor, max_distance=None if config.max_move == "any" else config.max_move,
        length_weight=config.contour_cost, backend=config.backend,
    )  # fmt: skip
    if proposal is regions:
        return regions
    device = regions.ids.device
    before, after = regions.to("cpu"), proposal.to(device)
    accepted = accept_moves(before, proposal, (max_rise * squared_error(regions) - squared_error(after)).cpu())
    if accepted is before:
        return regions
    return after if accepted is proposal else accepted.to(device)


def accept_moves(before: RegionMap, after: RegionMap, gain: Tensor) -> RegionMap:
    """Accept the moves between two maps on the CPU around which the render improves; lose no region.

    The moves were proposed by each region's Gaussians alone, but the render blends regions over soft contours. Changed
    pixels form groups with all pixels within two pixels. A group stays changed if the sum of its gain, (H, W), is
    positive.
    """
    from scipy import ndimage

    old, new = before.labels, after.labels
    changed, accepted = (old != new).numpy(), np.zeros(before.size, np.bool_)
    places = np.divmod(np.flatnonzero(changed), before.size[1])
    box = tuple(slice(max(0, place.min() - 3), place.max() + 4) for place in places)
    groups, count = ndimage.label(ndimage.binary_dilation(changed[box], iterations=2), np.ones((3, 3)))
    sums = ndimage.sum_labels(gain.numpy()[box].astype(np.float64), groups, np.arange(1, count + 1))
    accepted[box] = np.concatenate([[False], sums > 0])[groups]
    if not (accepted & changed).any():
        return before
    if accepted[changed].all():
        return after
    regions = after.relabel(torch.where(torch.from_numpy(accepted), new, old), "mean")
    return before if regions.num_regions < before.num_regions else regions
