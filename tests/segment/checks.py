"""What every segmenter promises."""

import torch
from torch import Tensor

from kcgs.segment import Segmentation


def assert_segmentation(result: Segmentation, size: tuple[int, ...]) -> None:
    """Check ids without gaps by decreasing area, and scores in [0, 1], or NaN, one for each region."""
    labels, scores, names = result
    areas = labels.flatten().bincount()
    assert labels.dtype == torch.int64 and labels.shape == size
    assert (areas > 0).all() and (areas[:-1] >= areas[1:]).all()
    assert scores is None or (scores.shape == areas.shape and ((0 <= scores) & (scores <= 1) | scores.isnan()).all())
    assert names is None or list(names) == labels.unique().tolist()


def split_image(height: int, width: int, column: int) -> Tensor:
    """Return an image that is red left of a column and blue right of it."""
    image = torch.zeros(3, height, width)
    image[0, :, :column], image[2, :, column:] = 1.0, 1.0
    return image
