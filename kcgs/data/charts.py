"""The two colour charts: images whose regions are known exactly."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from kcgs._check import check_count
from kcgs._repr import brief

# RGB, by row and column
_BLOCKS = (((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), ((0.0, 0.5, 0.0), (1.0, 0.5, 0.0), (0.5, 0.0, 0.5)))
# side of a block in pixels
_BLOCK_SIDE = 100

# RGB, clockwise from the top
_SECTORS = (
    (1.0, 0.0, 0.0),
    (1.0, 0.5, 0.0),
    (1.0, 1.0, 0.0),
    (0.0, 1.0, 0.0),
    (0.0, 1.0, 1.0),
    (0.0, 0.0, 1.0),
    (0.5, 0.0, 0.5),
    (1.0, 0.0, 1.0),
)
# pixels
_PIE_SIZE = 300
_PIE_RADIUS = 130.0
# half a sector, in radians: the first sector is centred at the top, so that no edge is a row, a column or a diagonal
_PIE_START = torch.pi / 8
# samples per side of a pixel on an edge
_SUBSAMPLES = 8


@brief
class ChartSample(NamedTuple):
    """A chart, :math:`(3, H, W)` float32 RGB in [0, 1], and the region of every pixel centre, :math:`(H, W)` int64."""

    image: Tensor
    labels: Tensor


def chart_2x3(scale: int = 1) -> ChartSample:
    """Make two rows of three flat blocks: red, green, blue over dark green, orange, purple.

    Args:
        scale: factor on the size of 200 x 300 pixels (height x width), at least 1.

    Returns:
        The chart, (200 scale, 300 scale); labels 0 to 5 in reading order.

    Raises:
        TypeError, ValueError: ``scale`` is no integer of at least 1.

    Example:
        >>> image, labels = chart_2x3()
        >>> tuple(image.shape), labels[150, 250].item(), image[:, 150, 250].tolist()
        ((3, 200, 300), 5, [0.5, 0.0, 0.5])
    """
    check_count("scale", scale)
    blocks = torch.tensor(_BLOCKS)
    rows, columns = blocks.shape[:2]
    ids = torch.arange(rows * columns).reshape(rows, columns)
    side = _BLOCK_SIDE * scale
    labels = ids.repeat_interleave(side, 0).repeat_interleave(side, 1)
    return ChartSample(blocks.flatten(0, 1)[labels].permute(2, 0, 1).contiguous(), labels)


def chart_pie(scale: int = 1) -> ChartSample:
    """Make a disc of eight flat sectors on white, its edges anti-aliased.

    The disc is centred and has a radius of 130 pixels at ``scale=1``; clockwise from the top the sectors are
    red, orange, yellow, green, cyan, blue, purple and magenta. A pixel is the mean of 8 x 8 samples.

    Args:
        scale: factor on the size of 300 x 300 pixels, at least 1. At every scale contours are exact, not enlarged.

    Returns:
        The chart, (300 scale, 300 scale); label 0 is the background, 1 to 8 the sectors.

    Example:
        >>> image, labels = chart_pie()
        >>> tuple(image.shape), labels.unique().tolist()
        ((3, 300, 300), [0, 1, 2, 3, 4, 5, 6, 7, 8])
        >>> tuple(chart_pie(scale=2).labels.shape)
        (600, 600)
    """
    check_count("scale", scale)
    centers = torch.arange(_PIE_SIZE * scale, dtype=torch.float64) + 0.5
    labels = _pie_region(centers[None, :], centers[:, None], scale)
    palette = torch.tensor([(1.0, 1.0, 1.0), *_SECTORS])
    image = palette[labels]
    # only pixels that touch another region can be mixed: the other pixels are not sampled, which saves time
    ids = labels[None].float()
    rows, columns = (F.max_pool2d(ids, 3, 1, 1) != -F.max_pool2d(-ids, 3, 1, 1))[0].nonzero(as_tuple=True)
    offsets = (torch.arange(_SUBSAMPLES, dtype=torch.float64) + 0.5) / _SUBSAMPLES
    x = (columns[:, None] + offsets)[:, None, :]
    y = (rows[:, None] + offsets)[:, :, None]
    image[rows, columns] = palette[_pie_region(x, y, scale)].mean(dim=(1, 2))
    return ChartSample(image.permute(2, 0, 1).contiguous(), labels)


def _pie_region(x: Tensor, y: Tensor, scale: int) -> Tensor:
    """Return the region of points given in pixels of the scaled chart."""
    x, y = x / scale - _PIE_SIZE / 2, y / scale - _PIE_SIZE / 2
    turn = torch.atan2(x, -y) + _PIE_START  # clockwise from the top, where the first sector is centred
    sector = (turn / (2 * torch.pi / len(_SECTORS))).floor().long() % len(_SECTORS)
    return torch.where(x**2 + y**2 < _PIE_RADIUS**2, sector + 1, 0)
