"""The filter of `pursuit.py` in Triton: two launches in place of hundreds of operations."""

from __future__ import annotations

import torch
import triton.language as tl
from torch import Tensor

from kcgs.kernels.cuda.triton_function import triton_function

# pixels per program
_PIXELS = 512


def blur(planes: Tensor, labels: Tensor | None, sigma: float, reach: int) -> Tensor:
    """Filter planes of images along columns, then along rows, each time over pixels of the same label only.

    Args:
        planes: (B, K, H, W), contiguous float32, on a CUDA device.
        labels: (B, H, W), or (1, H, W) for all images, contiguous; None: all pixels have the same label.
        sigma: standard deviation of the filter, in pixels; the last plane's filter is its square.
        reach: of the filters, in pixels.
    """
    batch, count, height, width = planes.shape
    area = height * width
    for stride, length in ((width, height), (1, width)):
        blurred = torch.empty_like(planes)
        with torch.cuda.device_of(planes):
            # without labels the kernel reads none: any address is valid
            _blur(
                (-(-area // _PIXELS), count, batch),
                planes, planes if labels is None else labels, blurred, area, stride, length,
                0 if labels is None or len(labels) == 1 else area,
                -0.5 / sigma**2, reach, MAPPED=labels is not None, PIXELS=_PIXELS,
            )  # fmt: skip
        planes = blurred
    return planes


@triton_function(warps=4)
def _blur(
    planes, labels, blurred, area, stride, length, labels_per_image, exponent, reach,
    MAPPED: tl.constexpr, PIXELS: tl.constexpr,
):  # fmt: skip
    pixel = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    inside = pixel < area
    place = pixel // stride % length
    plane = tl.program_id(1)
    scale = tl.where(plane == tl.num_programs(1) - 1, 2.0 * exponent, exponent)
    image = tl.program_id(2).to(tl.int64)
    first = (image * tl.num_programs(1) + plane) * area
    total = tl.zeros([PIXELS], tl.float32)
    labels += image * labels_per_image
    if MAPPED:
        label = tl.load(labels + pixel, mask=inside, other=0.0)
    for distance in range(-reach, reach + 1):
        mask = inside & (place + distance >= 0) & (place + distance < length)
        other = pixel + distance * stride
        if MAPPED:
            mask = mask & (tl.load(labels + other, mask=mask, other=-1.0) == label)
        total += tl.exp(scale * distance * distance) * tl.load(planes + first + other, mask=mask, other=0.0)
    tl.store(blurred + first + pixel, total, mask=inside)
