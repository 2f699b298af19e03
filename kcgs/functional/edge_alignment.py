"""How well the contours of a label map lie on the edges of an image."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from kcgs._check import check_image, check_labels

from .labels import edge_band

# Edge alignment: the blur before the gradient; how far a contour may lie beside its edge; the pixels about the contour
# that are left out, which the edge itself fills; and how far those that it is compared with lie away.
_SIGMA = 1.0
_SLACK = 1
_GAP = 3
_REACH = 8
_BLOCK = 1 << 20  # pixels whose gradient is taken at a time


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
