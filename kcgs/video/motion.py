"""Motion between two frames, and what it does to points and label maps."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

# the shorter side, in pixels, at which motion is estimated
_SIDE = 160
# half the side of the window of a pixel's motion, in pixels at that size
_RADIUS = 5
# iterations of the fixed point in `move_points`
_ITERATIONS = 5


def estimate_motion(previous: Tensor, image: Tensor) -> Tensor:
    """Return where each pixel of an image was in the previous one: (2, H, W), offsets (x, y) in pixels.

    Source: the iterative Lucas-Kanade solver of scikit-image, `optical_flow_ilk`, on smaller grey images.
    """
    from skimage.registration import optical_flow_ilk

    height, width = image.shape[1:]
    scale = min(1.0, _SIDE / min(height, width))
    size = max(1, round(height * scale)), max(1, round(width * scale))
    grey = [
        interpolate(frame.mean(0)[None, None], size, mode="area")[0, 0].cpu().numpy() for frame in (image, previous)
    ]
    rows, cols = optical_flow_ilk(*grey, radius=_RADIUS)
    motion = torch.from_numpy(np.stack([cols * (width / size[1]), rows * (height / size[0])])).to(image)
    return interpolate(motion[None], (height, width), mode="bilinear")[0]


def motion_at(motion: Tensor, points: Tensor) -> Tensor:
    """Sample a motion (2, H, W) at points (N, 2), bilinearly; beyond the image it is that of the border."""
    height, width = motion.shape[1:]
    grid = points / points.new_tensor([width, height]) * 2 - 1
    sampled = grid_sample(motion[None], grid[None, None].to(motion), padding_mode="border", align_corners=False)
    return sampled[0, :, 0].T.to(points)


def move_points(motion: Tensor, points: Tensor) -> Tensor:
    """Return where points (N, 2) of the previous image are in the image: q with q + motion(q) = p."""
    moved = points
    for _ in range(_ITERATIONS):
        moved = points - motion_at(motion, moved)
    return moved


def move_labels(motion: Tensor, labels: Tensor) -> Tensor:
    """Return the labels (H, W) of the previous image, each pixel's from where it was."""
    height, width = labels.shape
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    cols = (x.to(motion) + motion[0]).round().long().clamp(0, width - 1)
    rows = (y.to(motion) + motion[1]).round().long().clamp(0, height - 1)
    return labels[rows, cols]
