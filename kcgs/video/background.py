"""The background that a region hides in one frame of a video and others show."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kcgs.editing import dilate, inpaint
from kcgs.maps import nearest_labels

from .flow import sample

# pixels around a region that still have colours of it, since edges in photos are blurred: they are filled, too
_FRINGE = 3
# pixels between a Gaussian and where a motion puts it, up to which it follows the motion
_MAX_RESIDUAL = 1.0
# samples of three rows: with more, the motion of most rows is found more surely
_RANSAC_TRIALS = 200
# rows that determine a motion reliably
_MIN_ROWS = 12


def affine_motions(means: Tensor, background: Tensor) -> Tensor:
    """Return the affine motion (T, 3, 3) from the first frame to each that most rows of the background (T, N) have.

    Optical flow, which the fit follows, ends where a region hides the background; an affine motion goes on behind it.
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
    """Fill pixels of all frames from the nearest frame that shows them; `inpaint` fills those that none shows.

    Args:
        renders: (T, C, H, W).
        labels: (T, H, W).
        deleted: the pixels, bool (T, H, W); those around them are filled, too, but keep their labels.
        motions: affine, from the first frame to each, (T, 3, 3).

    Returns:
        The images and the labels.
    """
    holes = [dilate(mask, _FRINGE) for mask in deleted]
    originals = [_Pixels(*pixels) for pixels in zip(renders, labels, holes, strict=True)]
    results: list[_Pixels] = []
    for t, original in enumerate(originals):
        pixels = _Pixels(*(plane.clone() for plane in original))
        nearest = sorted(range(len(originals)), key=lambda s: abs(s - t))[1:]
        sources = [(s, originals[s]) for s in nearest]
        if t:  # pixels that no frame shows continue those of the frame before
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
    """Fill unknown pixels of the target, in place, from where a motion puts them in the source, if known there."""
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
