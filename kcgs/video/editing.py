"""Edits of all frames: what a region hides is filled from frames that show it, which a single image cannot."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

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

from .descent import FrameDescent
from .fitting import stack
from .motion import motion_at
from .target import Splats, Target

# pixels around a region that still have colours of it
_FRINGE = 3
# pixels between a Gaussian and where a motion puts it, from which on it is an outlier: relocated, or moving by itself
_MAX_RESIDUAL = 1.0
# samples of three rows: more find the motion of most rows more surely
_RANSAC_TRIALS = 200
# fewer rows do not determine a motion
_MIN_ROWS = 12


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
    regions, row_ids, deleted_ids = _check(scenes, region_ids)
    deleted_pixels, deleted_rows = torch.isin(regions.labels, deleted_ids), torch.isin(row_ids, deleted_ids)
    edited: list[Splats] = []
    with threads_for_kernels(scenes.size[0] * scenes.size[1]):
        motions = _background_motions(scenes.field.means.detach(), ~deleted_rows)
        images, labels = _fill_holes(scenes.render(), regions.labels, deleted_pixels, motions)
        filled = regions.relabel(labels, "mean")
        for t, scene in enumerate(scenes):
            means, cholesky, colors, _, _ = Splats.of(scene)
            region_ids = torch.where(deleted_rows[t], filled.image(t).ids[0], row_ids[t])
            colors[deleted_rows[t]] = 0.0
            if t:  # rows that filled the frame before go on
                rows, before = deleted_rows[t] & deleted_rows[t - 1], edited[-1]
                means[rows] = _apply(motions[t] @ motions[t - 1].inverse(), before.means[rows])
                cholesky[rows], colors[rows] = before.cholesky[rows], before.colors[rows]
                if before.region_ids is not None:
                    region_ids[rows] = before.region_ids[rows]
            start = Splats(means, cholesky, colors, region_ids, filled.image(t))
            movable, changed = torch.ones_like(deleted_rows[t]), torch.ones_like(deleted_pixels[t])
            unused = deleted_rows[t] & (colors == 0).all(-1)
            descent = FrameDescent(Target(images[t], FitConfig()), start, movable, changed)
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
    regions, row_ids, moved_ids = _check(scenes, region_ids)
    steps = check_offset(offset)
    behind = delete_region(scenes, region_ids)
    assert behind.regions is not None
    is_moved, field = torch.isin(row_ids, moved_ids), scenes.field
    rows = is_moved.any(0)
    means = field.means[:, rows] + field.means.new_tensor(steps)
    colors = (field.merged_colors() * is_moved[..., None])[:, rows]
    moved = GaussianField(means, field.cholesky[:, rows], colors, row_ids[:, rows], size=scenes.size)
    labels = shift_labels(regions.labels, torch.isin(regions.labels, moved_ids), steps, behind.regions.labels)[1]
    return Scene(join(behind.field, moved), regions.relabel(labels, "mean"), scenes.metadata)


def _check(scenes: Scene, region_ids: int | Iterable[int]) -> tuple[RegionMap, Tensor, Tensor]:
    """Return the maps, the ids of the rows (T, N), and the ids of the argument."""
    count, regions, row_ids = len(check_batch(scenes)), scenes.regions, scenes.field.region_ids
    if regions is None or row_ids is None or regions.num_maps != count:
        raise ValueError("scenes must have a label map for each frame, and region ids")
    ids = torch.tensor(check_region_ids(region_ids, regions.ids, "maps"), device=regions.ids.device)
    has_others = (~torch.isin(regions.labels, ids)).flatten(1).any(1)
    if not has_others.all():
        frame = int(has_others.min(0)[1])
        raise ValueError(f"region_ids must leave a region in every frame; got all regions of frame {frame}")
    return regions, row_ids, ids


def _background_motions(means: Tensor, background: Tensor) -> Tensor:
    """Return the affine motion (T, 3, 3) from the first frame to each that most rows of the background (T, N) have."""
    from skimage.measure import ransac
    from skimage.transform import AffineTransform

    motions = [torch.eye(3, dtype=torch.float64)]
    for t in range(1, len(means)):
        rows = background[t - 1] & background[t]
        points = [means[k][rows].double().cpu().numpy() for k in (t - 1, t)]
        model = None
        if len(points[0]) >= _MIN_ROWS:
            model, _ = ransac(
                points, AffineTransform, min_samples=3, residual_threshold=_MAX_RESIDUAL, max_trials=_RANSAC_TRIALS,
                rng=0,
            )  # fmt: skip
        motions.append(motions[-1] if model is None else torch.from_numpy(model.params) @ motions[-1])
    return torch.stack(motions)


def _apply(motion: Tensor, points: Tensor) -> Tensor:
    """Apply an affine motion (3, 3) to points (N, 2)."""
    matrix = motion.to(points)
    return points @ matrix[:2, :2].T + matrix[:2, 2]


class _Pixels(NamedTuple):
    """The pixels of a frame, some of them unknown."""

    image: Tensor  # [C, H, W]
    labels: Tensor  # [H, W]
    unknown: Tensor  # [H, W] bool


def _fill_holes(renders: Tensor, labels: Tensor, deleted: Tensor, motions: Tensor) -> tuple[Tensor, Tensor]:
    """Return the images and the labels of all frames with the deleted pixels (T, H, W) filled."""
    holes = [dilate(mask, _FRINGE) for mask in deleted]
    originals = [_Pixels(*pixels) for pixels in zip(renders, labels, holes, strict=True)]
    filled: list[_Pixels] = []
    for t, original in enumerate(originals):
        pixels = _Pixels(*(plane.clone() for plane in original))
        nearest = sorted(range(len(originals)), key=lambda s: abs(s - t))[1:]
        sources = [(s, originals[s]) for s in nearest]
        if t:  # pixels that no frame shows continue those of the frame before
            sources.append((t - 1, filled[-1]))
        for s, source in sources:
            if pixels.unknown.any():
                _copy(source, pixels, motions[s] @ motions[t].inverse())
        image, new_labels, unknown = pixels
        if unknown.any():
            image, new_labels = inpaint(image, unknown), nearest_labels(new_labels, unknown)
        new_labels = torch.where(deleted[t], new_labels, original.labels)  # the fringe keeps its labels
        filled.append(_Pixels(image, new_labels, torch.zeros_like(unknown)))
    return torch.stack([pixels.image for pixels in filled]), torch.stack([pixels.labels for pixels in filled])


def _copy(source: _Pixels, target: _Pixels, motion: Tensor) -> None:
    """Fill unknown pixels of the target, in place, from where a motion puts them in the source, if known there."""
    y, x = target.unknown.nonzero().T
    points = _apply(motion, torch.stack([x, y], -1).to(target.image) + 0.5)
    cols, rows = points.floor().long().unbind(-1)
    height, width = target.unknown.shape
    known = (cols >= 0) & (cols < width) & (rows >= 0) & (rows < height)
    known &= ~source.unknown[rows.clamp(0, height - 1), cols.clamp(0, width - 1)]
    y, x, rows, cols = y[known], x[known], rows[known], cols[known]
    target.image[:, y, x] = motion_at(source.image, points[known]).T
    target.labels[y, x] = source.labels[rows, cols]
    target.unknown[y, x] = False
