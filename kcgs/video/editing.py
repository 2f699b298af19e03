"""Edits of all frames: what a region hides is filled from frames that show it, which a single image cannot."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from kcgs.editing.inpainting import inpaint
from kcgs.editing.masks import check_offset, dilate, nearest_labels, shift_labels
from kcgs.editing.selection import check_region_ids
from kcgs.fitting import FitConfig
from kcgs.functional import RegionMap
from kcgs.kernels import threads_for_kernels
from kcgs.nn import GaussianField
from kcgs.nn.field import join
from kcgs.scene import Scene, check_batch

from .descent import Descent
from .fitting import stack
from .gaussians import Gaussians
from .motion import motion_at

# image (C, H, W), labels (H, W), and which pixels are not known (H, W)
Frame = tuple[Tensor, Tensor, Tensor]

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
    regions, ids, chosen = _check(scenes, region_ids)
    is_deleted, blank = torch.isin(regions.labels, chosen), torch.isin(ids, chosen)
    edited: list[Gaussians] = []
    with threads_for_kernels(scenes.size[0] * scenes.size[1]):
        motions = _background_motions(scenes.field.means.detach(), ~blank)
        targets, labels = _fill_targets(scenes.render(), regions.labels, is_deleted, motions)
        filled = regions.relabel(labels, "mean")
        for t, frame in enumerate(scenes):
            field, regions = frame.field, filled.image(t)
            means, cholesky, colors = (x.detach().clone() for x in (field.means, field.cholesky, field.merged_colors()))
            row_ids = torch.where(blank[t], regions.ids[0], ids[t])
            colors[blank[t]] = 0.0
            if t:  # rows that filled the frame before go on
                rows, before = blank[t] & blank[t - 1], edited[-1]
                means[rows] = _move(motions[t] @ motions[t - 1].inverse(), before.means[rows])
                cholesky[rows], colors[rows] = before.cholesky[rows], before.colors[rows]
                if before.region_ids is not None:
                    row_ids[rows] = before.region_ids[rows]
            start = Gaussians(means, cholesky, colors, row_ids, regions)
            free, changed = torch.ones_like(blank[t]), torch.ones_like(is_deleted[t])
            unused = blank[t] & (colors == 0).all(-1)
            descent = Descent(targets[t], start, FitConfig(), free, changed)
            edited.append(descent.run({0: float(unused.float().mean())}))
    return stack(edited, scenes.size, scenes.metadata)


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
    regions, ids, chosen = _check(scenes, region_ids)
    steps = check_offset(offset)
    behind = delete_region(scenes, region_ids)
    assert behind.regions is not None
    inside = torch.isin(ids, chosen)
    rows, field = inside.any(0), scenes.field
    means = field.means[:, rows] + field.means.new_tensor(steps)
    colors = (field.merged_colors() * inside[..., None])[:, rows]
    moved = GaussianField(means, field.cholesky[:, rows], colors, ids[:, rows], size=scenes.size)
    labels = shift_labels(regions.labels, torch.isin(regions.labels, chosen), steps, behind.regions.labels)[1]
    return Scene(join(behind.field, moved), regions.relabel(labels, "mean"), scenes.metadata)


def _check(scenes: Scene, region_ids: int | Iterable[int]) -> tuple[RegionMap, Tensor, Tensor]:
    """Return the maps, the ids of the rows (T, N), and the chosen ids."""
    count, regions, ids = len(check_batch(scenes)), scenes.regions, scenes.field.region_ids
    if regions is None or ids is None or regions.num_maps != count:
        raise ValueError("scenes must have a label map for each frame, and region ids")
    chosen = torch.tensor(check_region_ids(region_ids, regions.ids, "maps"), device=regions.ids.device)
    left = (~torch.isin(regions.labels, chosen)).flatten(1).any(1)
    if not left.all():
        raise ValueError(
            f"region_ids must leave a region in every frame; nothing is left of frame {int(left.min(0)[1])}"
        )
    return regions, ids, chosen


def _background_motions(means: Tensor, background: Tensor) -> Tensor:
    """Return the affine motion (T, 3, 3) from the first frame to each that most rows of the background (T, N) have."""
    from skimage.measure import ransac
    from skimage.transform import AffineTransform

    motions = [torch.eye(3, dtype=torch.float64)]
    for t in range(1, len(means)):
        rows = background[t - 1] & background[t]
        points = [means[k][rows].double().cpu().numpy() for k in (t - 1, t)]
        model = None
        if len(points[0]) >= _LEAST_ROWS:
            model, _ = ransac(
                points, AffineTransform, min_samples=3, residual_threshold=_LARGEST_RESIDUAL,
                max_trials=_RANSAC_TRIALS, rng=0,
            )  # fmt: skip
        motions.append(motions[-1] if model is None else torch.from_numpy(model.params) @ motions[-1])
    return torch.stack(motions)


def _move(motion: Tensor, points: Tensor) -> Tensor:
    """Apply an affine motion (3, 3) to points (N, 2)."""
    matrix = motion.to(points)
    return points @ matrix[:2, :2].T + matrix[:2, 2]


def _fill_targets(renders: Tensor, labels: Tensor, deleted: Tensor, motions: Tensor) -> tuple[Tensor, Tensor]:
    """Return all frames with what is deleted (T, H, W) filled, and their labels."""
    targets, filled = renders.clone(), labels.clone()
    holes = torch.stack([dilate(mask, _FRINGE) for mask in deleted])
    for t in range(len(renders)):
        unknown = holes[t].clone()
        sources = [
            (s, (renders[s], labels[s], holes[s])) for s in sorted(range(len(renders)), key=lambda s: abs(s - t))
        ]
        if t:  # as the frame before was continued
            sources.append((t - 1, (targets[t - 1], filled[t - 1], torch.zeros_like(unknown))))
        for s, source in sources[1:]:
            if not unknown.any():
                break
            _copy((targets[t], filled[t], unknown), source, motions[s] @ motions[t].inverse())
        if unknown.any():
            targets[t], filled[t] = inpaint(targets[t], unknown), nearest_labels(filled[t], unknown)
        filled[t] = torch.where(deleted[t], filled[t], labels[t])  # the fringe keeps its labels
    return targets, filled


def _copy(frame: Frame, source: Frame, motion: Tensor) -> None:
    """Take what is unknown in a frame, in place, from where the motion puts it in another, if that is known there."""
    y, x = frame[2].nonzero().T
    points = _move(motion, torch.stack([x, y], -1).to(frame[0]) + 0.5)
    cols, rows = points.floor().long().unbind(-1)
    height, width = frame[2].shape
    known = (cols >= 0) & (cols < width) & (rows >= 0) & (rows < height)
    known &= ~source[2][rows.clamp(0, height - 1), cols.clamp(0, width - 1)]
    y, x, rows, cols = y[known], x[known], rows[known], cols[known]
    frame[0][:, y, x] = motion_at(source[0], points[known]).T
    frame[1][y, x] = source[1][rows, cols]
    frame[2][y, x] = False
