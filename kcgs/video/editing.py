"""Edits of all frames: what a region hides is filled from frames that show it, which a single image cannot."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from kcgs.editing.checks import check_ids, check_offset
from kcgs.editing.fill import grow, inpaint
from kcgs.fitting import FitConfig
from kcgs.fitting.state import Gaussians
from kcgs.functional import RegionMap
from kcgs.kernels import threads_for_kernels
from kcgs.nn import GaussianField
from kcgs.scene import Scene, check_batch

from .descent import Descent

# pixels around a region that still have colours of it
_FRINGE = 3
# pixels: a Gaussian farther than this from where a motion puts it is relocated, or of something that moves by itself
_LARGEST_RESIDUAL = 1.0
_RANSAC_TRIALS = 200
# rows that determine a motion well
_LEAST_ROWS = 12


@torch.inference_mode(False)
@torch.no_grad()
def delete_region(scenes: Scene, region_ids: int | Iterable[int]) -> Scene:
    """Delete regions from all frames, and show what is behind them.

    Convention: a hidden pixel takes colour and label from the nearest frame that shows it. The Gaussians of the other
    regions say where it is there: their motion from each frame to the next is taken as affine. What no frame shows
    continues its surroundings. The rows of the deleted regions are fitted to that.

    Args:
        scenes: T frames with label maps, as :func:`fit_video` gives them.
        region_ids: an id of the maps, or several.

    Returns:
        New scenes with as many rows, without a graph.

    Raises:
        TypeError: no batch of scenes.
        ValueError: no label maps, an unknown id, or a frame of which nothing is left.

    Example:
        >>> labels = torch.zeros(3, 16, 24, dtype=torch.long)
        >>> for t in range(3):
        ...     labels[t, 4:12, 4 * t : 4 * t + 8] = 7
        >>> field = GaussianField(24 * torch.rand(3, 20, 2), torch.tensor([3.0, 0.0, 3.0]).expand(3, 20, 3),
        ...                       torch.rand(3, 20, 3), size=(16, 24)).assign_regions(labels)
        >>> delete_region(Scene(field, labels), 7).regions.ids
        tensor([0])
    """
    regions, ids, deleted = _check(scenes, region_ids)
    frames = list(scenes)
    background = ~torch.isin(ids, deleted)
    with threads_for_kernels(scenes.size[0] * scenes.size[1]):
        motions = _background_motions(scenes.field.means.detach(), background)
        is_deleted = torch.isin(regions.labels, deleted)
        targets, labels = _fill_targets([frame.render() for frame in frames], regions.labels, is_deleted, motions)
        edited: list[Gaussians] = []
        filled_map = regions.relabel(torch.stack(labels), "mean")
        for t, frame in enumerate(frames):
            field = frame.field
            means, cholesky, colors = (x.detach().clone() for x in (field.means, field.cholesky, field.merged_colors()))
            blank, row_ids = ~background[t], ids[t].clone()
            colors[blank] = 0.0
            row_ids[blank] = filled_map.image(t).ids[0]
            if t:
                again = blank & ~background[t - 1]
                before = edited[-1]
                means[again] = _move(motions[t - 1], before.means[again])
                cholesky[again], colors[again] = before.cholesky[again], before.colors[again]
                if before.region_ids is not None:
                    row_ids[again] = before.region_ids[again]
            filled = filled_map.image(t)
            start = Gaussians(means, cholesky, colors, row_ids, filled)
            everything = torch.ones_like(blank), torch.ones_like(is_deleted[t])
            descent = Descent(targets[t], start, FitConfig(), *everything)
            edited.append(descent.run({0: float((blank & (colors == 0).all(-1)).float().mean())}))
    means, cholesky, colors = (torch.stack(parts) for parts in zip(*(g[:3] for g in edited), strict=True))
    row_ids = torch.stack([g.region_ids for g in edited if g.region_ids is not None])
    return Scene(GaussianField(means, cholesky, colors, row_ids, size=scenes.size), filled_map, scenes.metadata)


@torch.inference_mode(False)
@torch.no_grad()
def move_region(scenes: Scene, region_ids: int | Iterable[int], offset: Sequence[float]) -> Scene:
    """Move regions in all frames, over whatever lies there; :func:`delete_region` fills what they leave.

    Args:
        scenes: T frames with label maps, as :func:`fit_video` gives them.
        region_ids: an id of the maps, or several, which move together.
        offset: (dx, dy) in pixels, whole.

    Returns:
        New scenes, without a graph. The rows of the regions come last.

    Raises:
        TypeError, ValueError: as :func:`delete_region`; an offset that is not two whole numbers.
    """
    regions, ids, moved = _check(scenes, region_ids)
    dx, dy = check_offset(offset, 1)
    behind = delete_region(scenes, region_ids)
    assert behind.regions is not None and behind.field.region_ids is not None
    inside = torch.isin(ids, moved)
    rows = inside.any(0)
    field = scenes.field
    means = torch.cat([behind.field.means, field.means[:, rows] + field.means.new_tensor([dx, dy])], 1)
    cholesky = torch.cat([behind.field.cholesky, field.cholesky[:, rows]], 1)
    colors = torch.where(inside[..., None], field.merged_colors(), 0.0)[:, rows]
    height, width = scenes.size
    y, x = (torch.arange(length, device=regions.ids.device) - step for length, step in ((height, dy), (width, dx)))
    y, x = torch.meshgrid(y, x, indexing="ij")
    source = regions.labels[:, y.clamp(0, height - 1), x.clamp(0, width - 1)]
    landed = torch.isin(source, moved) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    labels = torch.where(landed, source, behind.regions.labels)
    field = GaussianField(
        means, cholesky, torch.cat([behind.field.colors, colors], 1),
        torch.cat([behind.field.region_ids, ids[:, rows]], 1), size=scenes.size,
    )  # fmt: skip
    return Scene(field, regions.relabel(labels, "mean"), scenes.metadata)


def _check(scenes: Scene, region_ids: int | Iterable[int]) -> tuple[RegionMap, Tensor, Tensor]:
    """Return the maps, the ids of the rows (T, N), and the chosen ids."""
    count, regions, ids = len(check_batch(scenes)), scenes.regions, scenes.field.region_ids
    if regions is None or ids is None or regions.num_maps != count:
        raise ValueError("scenes must have a label map for each frame, and region ids")
    chosen = torch.tensor(check_ids(region_ids, regions.ids, "maps"), device=regions.ids.device)
    left = (~torch.isin(regions.labels, chosen)).flatten(1).any(1)
    if not left.all():
        raise ValueError(
            f"region_ids must leave a region in every frame; nothing is left of frame {int(left.min(0)[1])}"
        )
    return regions, ids, chosen


def _background_motions(means: Tensor, background: Tensor) -> list[np.ndarray]:
    """Return the affine motion (3, 3) from each frame to the next that most rows of the background (T, N) have."""
    from skimage.measure import ransac
    from skimage.transform import AffineTransform

    motions = []
    for t in range(len(means) - 1):
        rows = background[t] & background[t + 1]
        points = [means[k][rows].double().cpu().numpy() for k in (t, t + 1)]
        model = None
        if len(points[0]) >= _LEAST_ROWS:
            model, _ = ransac(
                points, AffineTransform, min_samples=3, residual_threshold=_LARGEST_RESIDUAL,
                max_trials=_RANSAC_TRIALS, rng=0,
            )  # fmt: skip
        motions.append(np.eye(3) if model is None else np.asarray(model.params))
    return motions


def _move(motion: np.ndarray, points: Tensor) -> Tensor:
    """Apply an affine motion to points (..., 2)."""
    matrix = torch.from_numpy(motion).to(points)
    return points @ matrix[:2, :2].T + matrix[:2, 2]


def _fill_targets(
    renders: list[Tensor], labels: Tensor, deleted: Tensor, motions: list[np.ndarray]
) -> tuple[list[Tensor], list[Tensor]]:
    """Return each frame with what is deleted (T, H, W) filled, and its labels."""
    targets: list[Tensor] = []
    filled: list[Tensor] = []
    holes = [grow(mask, _FRINGE) for mask in deleted]
    for t, (render, hole) in enumerate(zip(renders, holes, strict=True)):
        image, known, unknown = render.clone(), labels[t].clone(), hole.clone()
        for s in sorted((s for s in range(len(renders)) if s != t), key=lambda s: abs(s - t)):
            if not unknown.any():
                break
            _copy(image, known, unknown, renders[s], labels[s], ~holes[s], _between(motions, t, s))
        if t and unknown.any():  # as the frame before was continued
            _copy(image, known, unknown, targets[-1], filled[-1], torch.ones_like(hole), _between(motions, t, t - 1))
        if unknown.any():
            image, known = inpaint(image, unknown), _nearest(known, unknown)
        targets.append(image)
        filled.append(torch.where(deleted[t], known, labels[t]))  # the fringe keeps its labels
    return targets, filled


def _between(motions: list[np.ndarray], first: int, last: int) -> np.ndarray:
    """Return the motion from one frame to another."""
    total = np.eye(3)
    for step in range(min(first, last), max(first, last)):
        total = motions[step] @ total
    return total if first <= last else np.linalg.inv(total)


def _copy(
    image: Tensor,
    labels: Tensor,
    unknown: Tensor,
    source: Tensor,
    source_labels: Tensor,
    shown: Tensor,
    motion: np.ndarray,
) -> None:
    """Take unknown pixels, in place, from where they are in another image, if it shows them there."""
    height, width = unknown.shape
    y, x = unknown.nonzero().T
    points = _move(motion, torch.stack([x, y], -1).to(image) + 0.5)
    cols, rows = points.floor().long().unbind(-1)
    inside = (cols >= 0) & (cols < width) & (rows >= 0) & (rows < height)
    inside &= shown[rows.clamp(0, height - 1), cols.clamp(0, width - 1)]
    y, x, rows, cols, points = y[inside], x[inside], rows[inside], cols[inside], points[inside]
    grid = points / points.new_tensor([width, height]) * 2 - 1
    image[:, y, x] = grid_sample(source[None], grid[None, None], padding_mode="border", align_corners=False)[0, :, 0]
    labels[y, x] = source_labels[rows, cols]
    unknown[y, x] = False


def _nearest(labels: Tensor, unknown: Tensor) -> Tensor:
    """Give unknown pixels the label of the nearest other one."""
    from scipy.ndimage import distance_transform_edt

    rows, cols = distance_transform_edt(unknown.cpu().numpy(), return_distances=False, return_indices=True)
    return labels[torch.from_numpy(rows).long(), torch.from_numpy(cols).long()]
