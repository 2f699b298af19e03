"""Continue an image into a hole: the target that a filled hole is fitted to."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .texture import texture

# blocks are averaged until the hole has at most so many: the time of the solution grows faster than they
_MOST_UNKNOWN = 10_000
# within so many pixels of the hole its colours are those next to it, then these fade over as many more
_PLATEAU, _JOIN, _BLUR = 3.0, 5.0, 1.5
# pixels around the hole whose range of values, but for this share at either end, the hole keeps
_RING, _TAIL = 10, 0.03
# the fit misses the target by about this share of the range
_INSET = 0.03


def inpaint(image: Tensor, unknown: Tensor) -> Tensor:
    """Continue an image into its unknown pixels.

    Convention: a membrane, every value the mean of its neighbours, held by what is around the hole, and led over to
    what is next to it; and texture. A plate (biharmonic) is smoother where it starts, but overshoots in large holes.

    Args:
        image: :math:`(C, H, W)`.
        unknown: :math:`(H, W)` bool, not all of it.

    Returns:
        The image with other values at unknown pixels.
    """
    values, hole = image.to(torch.float64).cpu(), unknown.cpu()
    inner = _lead_over(values.numpy(), _membrane(values, hole), hole.numpy())
    inner += texture(torch.where(hole, torch.from_numpy(inner), values), hole).numpy()
    ring = values[:, grow(hole, _RING) & ~hole].numpy()
    low, high = np.quantile(ring, [_TAIL, 1 - _TAIL], axis=1)[..., None, None]
    inset = _INSET * (high - low)
    inner = inner.clip(low + inset, high - inset)
    return torch.where(unknown, torch.from_numpy(inner).to(image), image)


def grow(mask: Tensor, reach: int) -> Tensor:
    """Add the pixels within so many of a mask (H, W)."""
    return torch.nn.functional.max_pool2d(mask[None].float(), 2 * reach + 1, 1, reach)[0] > 0


def _membrane(image: Tensor, unknown: Tensor) -> NDArray[np.float64]:
    """Solve for the membrane on block means, and enlarge it."""
    step = max(1, math.ceil((int(unknown.sum()) / _MOST_UNKNOWN) ** 0.5))
    known = unknown.logical_not().to(image)[None]
    height, width = unknown.shape
    pad = (0, -width % step, 0, -height % step)
    shares, sums = (
        torch.nn.functional.avg_pool2d(torch.nn.functional.pad(t, pad), step) for t in (known, image * known)
    )
    means = (sums / shares.clamp_min(1e-9)).numpy()
    empty = (shares[0] == 0).numpy()
    means[:, empty] = _neighbour_means(means, empty)
    size = (height + pad[3], width + pad[1])
    smooth = torch.nn.functional.interpolate(torch.from_numpy(means)[None], size, mode="bilinear")
    return smooth[0, :, :height, :width].numpy()


def _neighbour_means(image: NDArray[np.float64], unknown: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return values (C, K) for the unknown pixels of (C, H, W), each the mean of its neighbours: one sparse system."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.linalg import splu

    count = int(unknown.sum())
    index = np.full(unknown.size, -1)
    index[unknown.ravel()] = np.arange(count)
    flat = image.reshape(len(image), -1)
    place = np.arange(unknown.size).reshape(unknown.shape)
    pairs = [(place[:, :-1], place[:, 1:]), (place[:-1], place[1:])]
    one = np.concatenate([side.ravel() for pair in pairs for side in pair])
    other = np.concatenate([side.ravel() for pair in pairs for side in pair[::-1]])
    one, other = one[index[one] >= 0], other[index[one] >= 0]
    inner = index[other] >= 0
    degree = np.bincount(index[one], minlength=count).astype(np.float64)
    edge = index[one[~inner]]
    right = np.stack([np.bincount(edge, channel[other[~inner]], count) for channel in flat], 1)
    rows = np.concatenate([index[one[inner]], np.arange(count)])
    cols = np.concatenate([index[other[inner]], np.arange(count)])
    entries = np.concatenate([np.full(int(inner.sum()), -1.0), degree])
    solution: NDArray[np.float64] = splu(coo_matrix((entries, (rows, cols)), (count, count)).tocsc()).solve(right).T
    return solution


def _lead_over(
    image: NDArray[np.float64], inner: NDArray[np.float64], unknown: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Add to the inner image what it differs by from the pixels next to the hole, less with the distance."""
    from scipy.ndimage import distance_transform_edt, gaussian_filter

    share = gaussian_filter((~unknown).astype(np.float64), _BLUR)
    difference = gaussian_filter((image - inner) * ~unknown, (0, _BLUR, _BLUR)) / np.maximum(share, 1e-6)
    fade = np.exp(-np.maximum(distance_transform_edt(unknown) - _PLATEAU, 0.0) / _JOIN)
    result: NDArray[np.float64] = inner + difference * fade
    return result
