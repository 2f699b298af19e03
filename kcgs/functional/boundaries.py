"""Contours of label maps: smooth ones, shares of pixels, how well they agree with other contours and with an image."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from kcgs._check import check_count, check_image, check_labels, check_number
from kcgs._repr import brief

from .labels import edge_band

# Edge alignment: the blur before the gradient; how far a contour may lie beside its edge; the pixels about the contour
# that are left out, which the edge itself fills; and how far those that it is compared with lie away.
_SIGMA = 1.0
_SLACK = 1
_GAP = 3
_REACH = 8
_BLOCK = 1 << 20  # pixels whose gradient is taken at a time


@brief
class BoundaryScore(NamedTuple):
    """How well two maps' boundaries agree, each 0-dim or (B,), in [0, 1]."""

    precision: Tensor
    recall: Tensor
    f: Tensor


def smooth_contours(labels: Tensor, supersample: int = 4, sigma: float = 1.5) -> Tensor:
    r"""Sample a label map on a finer grid, its contours being the smooth curves that their staircases stand for.

    Each indicator is blurred by a Gaussian, and every fine pixel takes the label with the largest blur: straight
    edges come back within a few hundredths of a pixel, corners sharper than `sigma` are rounded, and regions
    thinner than about twice `sigma` vanish. The result is what
    :meth:`RegionMap.from_labels` takes with the same `supersample`.

    Args:
        labels: integer, :math:`(H, W)`, non-negative.
        supersample: fine pixels along a pixel's side, 2 to 16.
        sigma: standard deviation of the blur in pixels, above 0, at most 8.

    Returns:
        int64, :math:`(kH, kW)`.

    Raises:
        TypeError, ValueError: labels are not an integer tensor; wrong shape, negative ids, a number out of range.

    Example:
        >>> steps = torch.arange(24)[None] > 2 * torch.arange(12)[:, None]
        >>> smooth_contours(steps.long(), 4).shape
        torch.Size([48, 96])
    """
    from scipy.ndimage import find_objects, gaussian_filter

    labels = check_labels("labels", labels, dims=(2,))
    supersample = check_count("supersample", supersample, 2, 16)
    sigma = check_number("sigma", sigma, 0.0, 8.0, unit="pixels", above=True)
    ids, index = np.unique(labels.cpu().numpy(), return_inverse=True)
    fine = index.reshape(labels.shape).repeat(supersample, 0).repeat(supersample, 1)
    out, best = fine.copy(), np.zeros(fine.shape, np.float32)
    reach = math.ceil(3 * sigma * supersample)
    for region, box in enumerate(find_objects(fine + 1)):
        window = tuple(slice(max(0, side.start - reach), side.stop + reach) for side in box)
        inside = (fine[window] == region).astype(np.float32)
        share = gaussian_filter(inside, sigma * supersample, mode="nearest", truncate=3.0)
        better = share > best[window]
        best[window][better] = share[better]
        out[window][better] = region
    return torch.from_numpy(ids[out]).to(labels.device)


def coverage(labels: Tensor, factor: int) -> Tensor:
    r"""Give the share of every pixel that each region of a finer label map covers.

    Not differentiable; :func:`polygon_coverage` is.

    Args:
        labels: integer, :math:`(kH, kW)` or :math:`(B, kH, kW)`, non-negative.
        factor: fine pixels along a pixel's side, k, at least 1.

    Returns:
        float32, :math:`(R, H, W)` or :math:`(B, R, H, W)`, regions in the order of ``labels.unique()`` (of the whole
        batch); they add up to 1.

    Raises:
        TypeError: labels are not an integer tensor, or the factor is no integer.
        ValueError: wrong shape, negative ids, or a size that the factor does not divide.

    Example:
        >>> coverage(torch.tensor([[5, 5, 5, 9], [5, 5, 9, 9]]), 2)
        tensor([[[1.0000, 0.2500]],
        <BLANKLINE>
                [[0.0000, 0.7500]]])
    """
    labels = check_labels("labels", labels)
    factor = check_count("factor", factor)
    height, width = labels.shape[-2:]
    if height % factor or width % factor:
        raise ValueError(f"factor must be a divisor of the sides of labels, {(height, width)}; got {factor}")
    split = labels.reshape(*labels.shape[:-2], height // factor, factor, width // factor, factor)
    # one region at a time: all indicators at once would take R times the fine map
    return torch.stack([(split == region).float().mean((-3, -1)) for region in labels.unique()], dim=-3)


def boundary_f_score(labels: Tensor, reference: Tensor, tolerance: float = 2.0) -> BoundaryScore:
    r"""Compare the boundaries of two label maps: precision, recall and their harmonic mean F.

    Convention: a pixel is on the boundary where its right, lower or lower right neighbour has another label, as in the
    evaluation of DAVIS. It is matched if a boundary pixel of the other map lies within ``tolerance`` (Euclidean
    distance); one pixel may match several, unlike in BSDS, whose one-to-one matching can only be stricter. Ids
    need not agree. A map without boundary has precision 1 (recall 1, if it is the reference); F is 0 where both are 0.

    Args:
        labels: integer label map, :math:`(H, W)` or :math:`(B, H, W)`.
        reference: the same shape and device.
        tolerance: in pixels, at least 0. DAVIS takes 0.008 of the diagonal.

    Returns:
        Three numbers an image, float32, 0-dim or :math:`(B)`.

    Raises:
        TypeError: labels are not integer.
        ValueError: wrong or different shapes or devices, negative ids, a tolerance that is negative or not finite.

    Example:
        >>> left, right = torch.arange(12)[None] > 4, torch.arange(12)[None] > 5
        >>> [score.item() for score in boundary_f_score(left.expand(9, 12).long(), right.expand(9, 12).long())]
        [1.0, 1.0, 1.0]
        >>> boundary_f_score(left.expand(9, 12).long(), right.expand(9, 12).long(), tolerance=0).f.item()
        0.0

    Source: Perazzi et al., "A benchmark dataset and evaluation methodology for video object segmentation", 2016.
    """
    labels, reference = check_labels("labels", labels), check_labels("reference", reference)
    if labels.shape != reference.shape or labels.device != reference.device:
        raise ValueError(
            f"reference must have the shape and device of labels, {tuple(labels.shape)} on {labels.device}; got "
            f"{tuple(reference.shape)} on {reference.device}"
        )
    check_number("tolerance", tolerance, 0, unit="pixels")
    size = labels.shape[-2:]
    pairs = zip(labels.reshape(-1, *size).cpu().numpy(), reference.reshape(-1, *size).cpu().numpy(), strict=True)
    shares = [_matched(_boundary(mine), _boundary(other), tolerance) for mine, other in pairs]
    precision, recall = torch.tensor(shares, device=labels.device).reshape(*labels.shape[:-2], 2).unbind(-1)
    return BoundaryScore(precision, recall, 2 * precision * recall / (precision + recall).clamp_min(1e-12))


def edge_alignment(image: Tensor, labels: Tensor) -> Tensor:
    r"""Say how well a map's contours lie on the edges of an image: in [0, 1], 1 on edges, 0.5 by chance.

    The mean of :func:`edge_alignment_map`, which says what it takes and raises. Of 51 maps made by people (21 of
    BSDS500, 30 of DAVIS 2017) 90 % lie between 0.65 and 0.93 and none below 0.63; mirrored, the same maps give 0.44 to
    0.54. Below 0.58 a map hardly belongs to the image.

    Returns:
        0-dim or :math:`(B)`, not differentiable; NaN for a map without contour.

    Example:
        >>> image = torch.zeros(3, 40, 60)
        >>> image[..., 30:] = 1.0
        >>> fits = (torch.arange(60) >= 30).long().expand(40, 60)
        >>> edge_alignment(image, fits), edge_alignment(image, fits.roll(15, 1)) < 0.51
        (tensor(1.), tensor(True))
    """
    return edge_alignment_map(image, labels).flatten(-2).nanmean(-1)


def edge_alignment_map(image: Tensor, labels: Tensor) -> Tensor:
    r"""Give each pixel on a contour the share of pixels around it where the image has a weaker edge.

    Convention: contour pixels are those beside a pixel of another label. The edge is the norm of the gradient (Sobel,
    after a blur of 1 pixel) over all channels, the largest of a pixel and its eight neighbours, so that a contour may
    lie a pixel beside its edge. It is compared with the pixels of the square 8 pixels to all sides that are more than 3
    pixels from every contour; equal ones count half. Contrast and exposure are of no influence.

    Args:
        image: floating, :math:`(C, H, W)` or :math:`(B, C, H, W)`.
        labels: integer label map, :math:`(H, W)` or :math:`(B, H, W)`, on the device of the image.

    Returns:
        Shape of `labels`, in [0, 1] (float32, or float64 for such images); NaN off the contours, and where all pixels
        around are too near to one.

    Raises:
        TypeError: an argument has another type.
        ValueError: shapes or devices that do not fit, no pixels, values that are not finite, negative ids.

    Example:
        >>> image = torch.zeros(1, 1, 40)
        >>> image[..., 20:] = 1.0
        >>> edge_alignment_map(image, (torch.arange(40)[None] >= 20).long())[0, 18:22]
        tensor([nan, 1., 1., nan])
    """
    image, labels = check_image("image", image).detach(), check_labels("labels", labels)
    if labels.shape != image.shape[:-3] + image.shape[-2:] or labels.device != image.device:
        raise ValueError(
            f"labels must have the size and device of the image, {tuple(image.shape)} on {image.device}; got "
            f"{tuple(labels.shape)} on {labels.device}"
        )
    maps = labels.reshape(-1, *labels.shape[-2:])
    edges = _edges(image.reshape(-1, *image.shape[-3:]).to(torch.promote_types(image.dtype, torch.float32)))
    ranks = [_ranks(edge, edge_band(each, 1), edge_band(each, _GAP)) for edge, each in zip(edges, maps, strict=True)]
    return torch.stack(ranks).reshape(labels.shape)


def _edges(image: Tensor) -> Tensor:
    """Return [B, H, W], the strongest gradient at a pixel or beside it."""
    from kornia.filters import gaussian_blur2d, spatial_gradient

    side = 2 * round(3 * _SIGMA) + 1
    margin, height, width = side // 2 + 1 + _SLACK, *image.shape[-2:]
    edges, rows = image.new_empty(len(image), height, width), max(1, _BLOCK // width)
    for top in range(0, height, rows):
        first = max(0, top - margin)
        block = image[..., first : top + rows + margin, :]
        blurred = gaussian_blur2d(block, (side, side), (_SIGMA, _SIGMA), border_type="replicate")
        strength = spatial_gradient(blurred).square().sum((1, 2)).sqrt()
        strongest = max_pool2d(strength, 2 * _SLACK + 1, stride=1, padding=_SLACK)
        edges[:, top : top + rows] = strongest[:, top - first :][:, :rows]
    return edges


def _ranks(edges: Tensor, contour: Tensor, near: Tensor) -> Tensor:
    ranks = torch.full_like(edges, math.nan)
    padded = pad(torch.where(near, math.nan, edges), [_REACH] * 4, value=math.nan)
    offsets = torch.arange(2 * _REACH + 1, device=edges.device)
    # in parts: a window of 289 numbers for each contour pixel
    for part in contour.nonzero().split(1 << 14):
        rows, columns = part.unbind(1)
        around = padded[(rows[:, None] + offsets)[:, :, None], (columns[:, None] + offsets)[:, None, :]].flatten(1)
        strength = edges[rows, columns][:, None]
        weaker = (around < strength).sum(1) + 0.5 * (around == strength).sum(1)
        ranks[rows, columns] = (weaker / around.isfinite().sum(1)).to(edges.dtype)  # 0 of 0 is NaN
    return ranks


def _boundary(labels: Any) -> Any:
    """Mark the pixels whose right, lower or lower right neighbour differs."""
    grown = np.pad(labels, ((0, 1), (0, 1)), mode="edge")
    return (labels != grown[:-1, 1:]) | (labels != grown[1:, :-1]) | (labels != grown[1:, 1:])


def _matched(mine: Any, other: Any, tolerance: float) -> tuple[float, float]:
    """Return which share of `mine` lies near `other`, and the reverse; 1 where there is nothing to match."""
    from scipy.ndimage import distance_transform_edt

    def share(these: Any, those: Any) -> float:
        if not these.any():
            return 1.0
        return float((distance_transform_edt(~those)[these] <= tolerance).mean()) if those.any() else 0.0

    return share(mine, other), share(other, mine)
