"""Dilate masks, shift label maps, and check offsets."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from kcgs._check import check_number
from kcgs.errors import InvalidArgument, InvalidArgumentType

# largest offset in pixels; a larger one is surely an error
_LARGEST_OFFSET = 1e8
# largest distance of an offset from a whole number, in pixels
_OFFSET_TOLERANCE = 1e-6


def dilate(mask: Tensor, reach: int) -> Tensor:
    """Add the pixels within `reach` rows and columns of a mask (H, W)."""
    rows = max_pool2d(mask[None].float(), (2 * reach + 1, 1), 1, (reach, 0))
    return max_pool2d(rows, (1, 2 * reach + 1), 1, (0, reach))[0] > 0


def shift_labels(labels: Tensor, mask: Tensor, offset: tuple[int, int], background: Tensor) -> tuple[Tensor, Tensor]:
    """Move the labels of a mask over background labels, (..., H, W); return the moved mask and the new labels."""
    dx, dy = (max(-length, min(step, length)) for length, step in zip(labels.shape[:-3:-1], offset, strict=True))
    landing = pad(mask, (dx, -dx, dy, -dy))
    return landing, torch.where(landing, labels.roll((dy, dx), (-2, -1)), background)


def check_offset(offset: Sequence[float]) -> tuple[int, int]:
    """Validate an offset (dx, dy), and return it in whole pixels."""
    pair = offset.tolist() if isinstance(offset, Tensor | np.ndarray) else offset
    if not isinstance(pair, Sequence) or isinstance(pair, str):
        raise InvalidArgumentType("offset", "(dx, dy) in pixels", repr(offset))
    if len(pair) != 2:
        raise InvalidArgument("offset", "(dx, dy)", repr(offset))
    steps = [check_number("offset", step) for step in pair]
    if any(abs(step) > _LARGEST_OFFSET or abs(step - round(step)) > _OFFSET_TOLERANCE for step in steps):
        raise InvalidArgument("offset", "whole multiples of 1 pixel", repr(offset))
    return round(steps[0]), round(steps[1])
