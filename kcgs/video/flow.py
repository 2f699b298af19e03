"""Optical flow between two images, and points and label maps that move with it."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

# shorter side of the reduced images whose flow is estimated, in pixels; larger images take longer and show finer motion
_SIDE = 160
# half the side of the window in which the flow is constant, in reduced pixels; larger windows are more robust
_RADIUS = 5
# a scene cut is where the squared error of the moved frame before is above this share of the image's variance
_CUT_SHARE = 0.5
# fixed-point iterations of `move_points`: they converge where offsets change by less than a pixel per pixel
_ITERATIONS = 5


def optical_flow(previous: Tensor, image: Tensor) -> Tensor:
    """Return the offset (x, y) from each pixel of an image to its place in the previous image, (2, H, W), in pixels.

    An image with a side of one pixel has no slope along it: its offsets are 0.

    Source: the iterative Lucas-Kanade solver of scikit-image, `optical_flow_ilk`, on reduced grey images.
    """
    from skimage.registration import optical_flow_ilk

    height, width = image.shape[1:]
    if min(height, width) == 1:
        return image.new_zeros(2, height, width)
    scale = min(1.0, _SIDE / min(height, width))
    size = max(1, round(height * scale)), max(1, round(width * scale))
    grey = [
        interpolate(frame.mean(0)[None, None], size, mode="area")[0, 0].cpu().numpy() for frame in (image, previous)
    ]
    rows, cols = optical_flow_ilk(*grey, radius=_RADIUS)
    flow = torch.from_numpy(np.stack([cols * (width / size[1]), rows * (height / size[0])])).to(image)
    return interpolate(flow[None], (height, width), mode="bilinear")[0]


def sample(planes: Tensor, points: Tensor) -> Tensor:
    """Sample a flow or an image (C, H, W) bilinearly at points (N, 2); outside, it has the values of its border."""
    height, width = planes.shape[1:]
    grid = points / points.new_tensor([width, height]) * 2 - 1
    values = grid_sample(planes[None], grid[None, None].to(planes), padding_mode="border", align_corners=False)
    return values[0, :, 0].T.to(points)


def is_cut(squared_error: Tensor, image: Tensor) -> bool:
    """Return whether an image (C, H, W) begins another shot: the moved frame before has this squared error."""
    return float(squared_error.mean()) > _CUT_SHARE * float(image.var((1, 2)).mean())


def move_image(flow: Tensor, image: Tensor) -> Tensor:
    """Return an image (C, H, W) whose pixels are sampled at their places in the previous image."""
    return sample(image, _places(flow).flatten(1).T + 0.5).T.reshape(image.shape)


def move_points(flow: Tensor, points: Tensor) -> Tensor:
    """Return the places q in the image of points p (N, 2) of the previous image: q + flow(q) = p."""
    places = points
    for _ in range(_ITERATIONS):
        places = points - sample(flow, places)
    return places


def move_labels(flow: Tensor, labels: Tensor) -> Tensor:
    """Return the labels (H, W) of the image, each read at the pixel's place in the previous image."""
    height, width = labels.shape
    cols, rows = _places(flow).round().long()
    return labels[rows.clamp(0, height - 1), cols.clamp(0, width - 1)]


def _places(flow: Tensor) -> Tensor:
    """Return the column and the row of each pixel's place in the previous image, (2, H, W)."""
    y, x = torch.meshgrid(*(torch.arange(side) for side in flow.shape[1:]), indexing="ij")
    return torch.stack([x, y]).to(flow) + flow
