"""The separable Gaussian filter of metrics, contours and matching pursuit, and the mean of blocks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad


def gaussian_taps(sigma: float, radius: int) -> list[float]:
    """Return exp(-0.5 k^2 / sigma^2) for k = 0 to `radius`: the half of a symmetric window, its centre first."""
    return [1.0, *(math.exp(-0.5 * (k / sigma) ** 2) for k in range(1, radius + 1))]


def blur(maps: Tensor, taps: Sequence[float]) -> Tensor:
    """Filter (..., H, W) along one axis, then along the other, at positions where the window lies inside.

    Args:
        maps: floating.
        taps: half of the symmetric window, its centre first.

    Returns:
        (..., H - 2k, W - 2k) for k + 1 taps.
    """
    if torch.compiler.is_compiling():  # torch.compile knows no function with a jvp
        return _filter(maps, taps)
    return torch.as_tensor(_Blur.apply(maps, tuple(taps)))  # type: ignore[no-untyped-call]


def halve(planes: Tensor) -> Tensor:
    """Average blocks of 2 x 2, (..., h, w), without an odd last row; on one core five times faster than in torch."""
    rows = planes[..., : planes.shape[-2] // 2 * 2 : 2, :] + planes[..., 1::2, :]
    return (rows[..., : rows.shape[-1] // 2 * 2 : 2] + rows[..., 1::2]).mul_(0.25)


def _filter(maps: Tensor, taps: Sequence[float]) -> Tensor:
    """Add shifted copies: ten times faster on one core than torch's convolution of single channels."""
    window = [*taps[:0:-1], *taps]
    for dim in (-2, -1):
        length = maps.shape[dim] - len(window) + 1
        blurred = maps.narrow(dim, 0, length) * window[0]
        for k, tap in enumerate(window[1:], 1):
            blurred = blurred.add_(maps.narrow(dim, k, length), alpha=tap)
        maps = blurred
    return maps


class _Blur(torch.autograd.Function):
    """The filter is its own transpose; autograd of its slices would write an image for each tap."""

    generate_vmap_rule = True

    @staticmethod
    def forward(maps: Tensor, taps: tuple[float, ...]) -> Tensor:
        return _filter(maps, taps)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, tuple[float, ...]], output: Tensor) -> None:
        _, ctx.taps = inputs

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return blur(pad(gradient, [2 * (len(ctx.taps) - 1)] * 4), ctx.taps), None

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, _: None) -> Tensor:
        return blur(tangent, ctx.taps)
