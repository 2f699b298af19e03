"""Antialiased labels: a smooth curve through a contour cuts the pixels beside it.

It uses standard operators only, and no shape depends on values, so that an ONNX graph can hold it.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

# pixels along a straight piece of contour within which its ends are looked for
_SEARCH = 32
# the weight of a pixel on a line one pixel wide is multiplied by _LINE_SUM / sixteenths - 1; `sixteenths` are the share
# of the pixel's label in the 3 x 3 pixels around it, of which a side counts twice a corner, and the middle four times
_LINE_SUM = 21.6
_LINE = 8  # most sixteenths of a pixel that counts as part of a line one pixel wide


class SmoothLabels(NamedTuple):
    """The weights of two labels in each pixel, (B, H, W): of the pixel's label, and of one neighbour's."""

    weight: Tensor  # float64, of its own label
    other: Tensor  # label of the neighbour
    other_weight: Tensor  # float64


def antialias(labels: Tensor, is_sharp: Tensor) -> SmoothLabels:
    """Antialias labels, (B, H, W); lines one pixel wide get a larger weight where their contours are sharp.

    The sides of pixels in a row that have one label above them and one below form a piece of contour. Where the contour
    goes on one pixel higher or lower, and along the row again, the curve runs through the middle of that step. The
    curve is the parabola through three points: the middles of the steps at both ends of the piece, or an end itself
    where there is no step, and the middle of the piece. A straight contour of any slope becomes straight. If two
    neighbours take a part of a pixel, the neighbour that takes more counts.
    """
    share, sixteenths = torch.zeros_like(labels, dtype=torch.float64), torch.zeros_like(labels)
    other = labels
    for is_column in (False, True):
        image = labels.mT if is_column else labels
        height = _curve(image)
        # the parts of a pixel that the rows above and below take; the row below takes it across its own upper side
        for taken, step in ((-height, -1), (shifted(height, 1, 0) * (shifted(image, 1, 0) != image), 1)):
            parts = taken, shifted(image, step, 0)
            part, neighbour = (p.mT for p in parts) if is_column else parts
            other, share = torch.where(part > share, neighbour, other), torch.maximum(share, part)
    for down, right in product((-1, 0, 1), (-1, 0, 1)):
        is_same = shifted(labels, down, right) == labels
        sixteenths = sixteenths + (2 - down * down) * (2 - right * right) * is_same
    gain = torch.where((sixteenths <= _LINE) & is_sharp, _LINE_SUM / sixteenths - 1, torch.ones_like(share))
    return SmoothLabels((1 - share) * gain, other, share)


def _curve(image: Tensor) -> Tensor:
    """Return how far the curve runs above the upper side of each pixel, in pixels; 0 where there is no contour."""
    left, first = _ends(image)
    right, last = (t.flip(-1) for t in _ends(image.flip(-1)))
    place = (right - left).double() / (left + right + 1)  # from 1 at the left end to -1 at the right one
    height = ((first - last) * place + (first + last) * place.square()) / 4
    return torch.where(image != shifted(image, -1, 0), height, 0.0)


def _ends(image: Tensor) -> tuple[Tensor, Tensor]:
    """Return each pixel's distance to the left end of the piece above it, and the step there: 1 up, -1 down, or 0."""
    (above2, left_above2), (above, left_above), (own, left), (below, left_below) = (
        (shifted(image, y, 0), shifted(image, y, -1)) for y in (-2, -1, 0, 1)
    )
    goes_on = (left == own) & (left_above == above)
    up = (left == own) & (left_above == own) & ~((left_above2 == own) & (above2 == above))
    down = (left == above) & (left_above == above) & ~((left_below == above) & (below == own))
    column = torch.arange(image.shape[-1], device=image.device)
    ends = torch.where(goes_on, -1, 3 * column + 1 + up.long() - down.long())
    nearest = max_pool2d(pad(ends.float(), (_SEARCH - 1, 0), value=-1.0), (1, _SEARCH), 1).long()
    is_end = nearest >= 0
    return torch.where(is_end, column - nearest // 3, _SEARCH), torch.where(is_end, nearest % 3 - 1, 0)


def shifted(image: Tensor, down: int, right: int) -> Tensor:
    """Return the value so many pixels below and to the right of each pixel, (B, H, W); the border repeats."""
    for dim, step in ((-2, down), (-1, right)):
        if step:
            length = image.shape[dim]
            places = (torch.arange(length, device=image.device) + step).clamp(0, length - 1)
            image = image.index_select(dim, places)
    return image
