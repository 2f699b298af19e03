"""A frame between two others: Gaussians that both have, and contours, on their way."""

from __future__ import annotations

from typing import Any

import numpy as np

from kcgs.codec.exact import Floats, Integers
from kcgs.codec.gaussians.quantize import Parameters

from .carried import Frame
from .motion import expand


def between(first: Frame, second: Frame, share: float, size: tuple[int, int]) -> Frame:
    """Return the frame at `share`, 0 to 1, of the way from a frame to the one that is carried on from it.

    Centres, colours and covariances go straight, areas by their geometric mean. Gaussians that only one of the two has
    move with their region and fade. Contours move with their regions, too, from both sides; where the two maps differ,
    a pixel has the label that it lies deeper in.
    """
    _, old, new = np.intersect1d(first.key, second.key, assume_unique=True, return_indices=True)
    a, b = (_pick(frame.gaussians, index) for frame, index in ((first, old), (second, new)))
    index = None
    if first.index is not None:
        index = _map_between(first.index, second.index, second.numbers, share, size)
    regions = 1 + int(max(first.region.max(), second.region.max()))
    count = np.maximum(np.bincount(second.region[new], minlength=regions), 1)
    steps = (b.means - a.means).T
    shift = np.stack([np.bincount(second.region[new], step, regions) / count for step in steps], -1)
    gone, born = (np.setdiff1d(np.arange(len(f.key)), at) for f, at in ((first, old), (second, new)))
    parts = [_mean(a, b, share)]
    for frame, rest, moved, shown in ((first, gone, share, 1 - share), (second, born, share - 1, share)):
        means, cholesky, colors = _pick(frame.gaussians, rest)
        parts.append(Parameters(means + moved * shift[frame.region[rest]], cholesky, shown * colors))
    region = np.concatenate([second.region[new], first.region[gone], second.region[born]])
    key = np.concatenate([second.key[new], first.key[gone], second.key[born]])
    gaussians = Parameters(*(np.concatenate(numbers) for numbers in zip(*parts, strict=True)))
    seen = np.ones(len(region), np.bool_) if index is None else np.isin(region, np.unique(index))
    gaussians = Parameters(*(numbers[seen].astype(np.float32) for numbers in gaussians))
    return Frame(gaussians, region[seen], key[seen], index, second.numbers)


def _pick(gaussians: Parameters, index: Integers) -> Parameters:
    return Parameters(*(numbers[index].astype(np.float64) for numbers in gaussians))


def _mean(a: Parameters, b: Parameters, share: float) -> Parameters:
    """Return Gaussians between those of two frames."""
    xx, xy, yy = ((1 - share) * p + share * q for p, q in zip(_covariance(a), _covariance(b), strict=True))
    l11 = np.sqrt(xx)
    l21 = xy / l11
    l22 = np.sqrt(np.maximum(yy - l21 * l21, 1e-12))
    product = [numbers.cholesky[:, 0] * numbers.cholesky[:, 2] for numbers in (a, b)]
    grown = np.sqrt(product[0] ** (1 - share) * product[1] ** share / (l11 * l22))
    return Parameters(
        (1 - share) * a.means + share * b.means,
        np.stack([l11, l21, l22], -1) * grown[:, None],
        (1 - share) * a.colors + share * b.colors,
    )


def _covariance(gaussians: Parameters) -> tuple[Floats, Floats, Floats]:
    l11, l21, l22 = gaussians.cholesky.T
    return l11 * l11, l11 * l21, l21 * l21 + l22 * l22


def _map_between(first: Any, second: Any, numbers: Integers, share: float, size: tuple[int, int]) -> Any:
    """Return the map between two, (H, W)."""
    from scipy.ndimage import distance_transform_edt

    from kcgs.codec.labels import move_labels  # loads numba

    forth = move_labels(first, expand(np.round(share * numbers).astype(np.int64), size))
    back = move_labels(second, expand(np.round((share - 1) * numbers).astype(np.int64), size))
    if (forth == back).all():
        return forth
    depths = []
    for index in (forth, back):
        inner = np.ones(index.shape, np.bool_)
        down, across = index[1:] != index[:-1], index[:, 1:] != index[:, :-1]
        inner[1:] &= ~down
        inner[:-1] &= ~down
        inner[:, 1:] &= ~across
        inner[:, :-1] &= ~across
        depths.append(distance_transform_edt(inner))
    return np.where((1 - share) * (depths[0] + 0.5) >= share * (depths[1] + 0.5), forth, back)
