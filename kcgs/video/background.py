"""Restore the background that a region hides in one frame of a video from frames that show it."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kcgs.editing import dilate, inpaint
from kcgs.maps import nearest_labels

from .flow import sample

# width of the rim around a region that is filled too, in pixels: edges in photos are blurred
_FRINGE = 3
# a Gaussian follows a motion if it is at most this far from the place that the motion predicts, in pixels
_MAX_RESIDUAL = 1.0
# motions that are tried, each of three rows; more trials take longer and miss the motion of most rows less often
_RANSAC_TRIALS = 200
# with fewer rows the motion between two frames is not estimated: the background counts as still
_MIN_ROWS = 12


def affine_motions(means: Tensor, background: Tensor) -> Tensor:
    """Estimate the affine motion of the background from the first frame to each frame, (T, 3, 3).

    Gaussians follow optical flow, which ends where a region hides the background. An affine motion continues there.

    Args:
        means: (T, N, 2).
        background: mask of the rows that belong to the background, bool (T, N); most of them have the same motion.
    """
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


def restore_background(renders: Tensor, labels: Tensor, deleted: Tensor, motions: Tensor) -> tuple[Tensor, Tensor]:
    """Fill deleted pixels of each frame from the nearest frame that shows them; `inpaint` fills the rest.

    Args:
        renders: (T, C, H, W).
        labels: (T, H, W).
        deleted: mask of the pixels to fill, bool (T, H, W); a rim around them is filled too, but keeps its labels.
        motions: affine, from the first frame to each frame, (T, 3, 3).

    Returns:
        The new images and the new labels.
    """
    holes = [dilate(mask, _FRINGE) for mask in deleted]
    originals = [_Pixels(*pixels) for pixels in zip(renders, labels, holes, strict=True)]
    results: list[_Pixels] = []
    for t, original in enumerate(originals):
        pixels = _Pixels(*(plane.clone() for plane in original))
        nearest = sorted(range(len(originals)), key=lambda s: abs(s - t))[1:]
        sources = [(s, originals[s]) for s in nearest]
        if t:  # pixels that no frame shows are copied from the filled frame before
            sources.append((t - 1, results[-1]))
        for s, source in sources:
            if pixels.unknown.any():
                _copy(source, pixels, motions[s] @ motions[t].inverse())
        image, new_labels, unknown = pixels
        if unknown.any():
            image, new_labels = inpaint(image, unknown), nearest_labels(new_labels, unknown)
        new_labels = torch.where(deleted[t], new_labels, original.labels)  # the fringe keeps its labels
        results.append(_Pixels(image, new_labels, torch.zeros_like(unknown)))
    return torch.stack([pixels.image for pixels in results]), torch.stack([pixels.labels for pixels in results])


class _Pixels(NamedTuple):
    """The pixels of a frame, some of them unknown."""

    image: Tensor  # [C, H, W]
    labels: Tensor  # [H, W]
    unknown: Tensor  # [H, W] bool


def _copy(source: _Pixels, target: _Pixels, motion: Tensor) -> None:
    """Copy to each unknown pixel of the target, in place, the pixel of the source to which a motion leads, if known."""
    y, x = target.unknown.nonzero().T
    points = apply_affine(motion, torch.stack([x, y], -1).to(target.image) + 0.5)
    cols, rows = points.floor().long().unbind(-1)
    height, width = target.unknown.shape
    is_known = (cols >= 0) & (cols < width) & (rows >= 0) & (rows < height)
    is_known &= ~source.unknown[rows.clamp(0, height - 1), cols.clamp(0, width - 1)]
    y, x, rows, cols = y[is_known], x[is_known], rows[is_known], cols[is_known]
    target.image[:, y, x] = sample(source.image, points[is_known]).T
    target.labels[y, x] = source.labels[rows, cols]
    target.unknown[y, x] = False


def apply_affine(motion: Tensor, points: Tensor) -> Tensor:
    """Apply an affine motion (3, 3) to points (N, 2)."""
    matrix = motion.to(points)
    return points @ matrix[:2, :2].T + matrix[:2, 2]
