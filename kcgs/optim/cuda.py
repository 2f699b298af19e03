"""The step of `adam.py` in one launch of Triton: a thread moves a Gaussian, float32, on a CUDA device.

Intermediate numbers are float64, as in `loops.py`. A Gaussian that is frozen, by a negative age, or whose gradient is
not finite, stays as it is.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from kcgs.kernels.cuda.triton_function import triton_function

from .settings import Adam, Bounds

# Gaussians per program
_ROWS = tl.constexpr(128)


def step(tables: list[Tensor], gradients: list[Tensor | None], geometry: Adam, colors: Adam, bounds: Bounds) -> None:
    """Move means, factors, colours and, if there are any, opacities; a table without a gradient stays.

    Args:
        tables: [..., N, 2], [..., N, 3], [..., N, C], and perhaps [..., N], contiguous.
        gradients: of each table; None where it has none.
        geometry: settings and averages of the first two tables.
        colors: settings and averages of the other tables.
        bounds: of the first two tables.
    """
    count, channels = tables[0].shape[:-1].numel(), tables[2].shape[-1]
    has_gradient = [gradient is not None for gradient in gradients] + [False]
    # a table without a gradient passes any address: it is not read
    addresses = [table if gradient is None else gradient for table, gradient in zip(tables, gradients, strict=True)]
    opacities = tables[3:] or tables[:1]
    with torch.cuda.device_of(tables[0]):
        _step(
            (-(-count // _ROWS.value),),
            *tables[:3], *opacities, *addresses[:3], *(addresses[3:] or tables[:1]), *geometry, *colors, *bounds,
            count,
            CHANNELS=channels, COLUMNS=channels + len(tables[3:]), MEANS=has_gradient[0], CHOLESKY=has_gradient[1],
            COLORS=has_gradient[2], OPACITIES=has_gradient[3], LR_LOADED=isinstance(geometry.lr, Tensor),
            COLOR_LR_LOADED=isinstance(colors.lr, Tensor),
        )  # fmt: skip


@triton.jit  # type: ignore[untyped-decorator]
def _gradient(gradients, place, mask, EXISTS: tl.constexpr):
    if EXISTS:
        return tl.load(gradients + place, mask=mask, other=0.0).to(tl.float64)
    else:
        return tl.zeros_like(place).to(tl.float64)


@triton.jit  # type: ignore[untyped-decorator]
def _count_step(ages, row, mask, lr, beta1, beta2, LOADED: tl.constexpr):
    """Count the step of rows that are not frozen; return their mask and the two factors of their age in Adam's step.

    They are the learning rate over the first average's bias correction, and the inverse root of the second's.
    """
    age = tl.load(ages + row, mask=mask, other=0.0) + 1.0
    mask = mask & (age > 0.0)
    age = tl.where(mask, age, 1.0)
    tl.store(ages + row, age, mask=mask)
    age = age.to(tl.float64)
    if LOADED:
        lr = tl.load(lr)
    zero = tl.zeros_like(age)
    power1, power2 = tl.exp(tl.log(beta1 + zero) * age), tl.exp(tl.log(beta2 + zero) * age)
    return mask, lr / (1.0 - power1), 1.0 / tl.sqrt(1.0 - power2)


@triton.jit
def _adam(gradient, place, mask, settings):
    """Update the averages of a column, and return Adam's step."""
    averages, squares, rate, root, beta1, beta2, eps = settings
    average = tl.load(averages + place, mask=mask, other=0.0).to(tl.float64)
    square = tl.load(squares + place, mask=mask, other=0.0).to(tl.float64)
    average += (1.0 - beta1) * (gradient - average)
    square = beta2 * square + (1.0 - beta2) * gradient * gradient
    tl.store(averages + place, average.to(tl.float32), mask=mask)
    tl.store(squares + place, square.to(tl.float32), mask=mask)
    return -rate * average / (root * tl.sqrt(square) + eps)


@triton.jit
def _clamp(value, low, high):
    return tl.where(value < low, low, tl.where(value > high, high, value))  # NaN stays NaN


@triton.jit
def _widen(l11, l21, l22, min_sigma):
    """Return the factor of `frame.widen`."""
    xx, xy, yy, least = l11 * l11, l11 * l21, l21 * l21 + l22 * l22, min_sigma * min_sigma
    mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    gap = tl.sqrt(half * half + xy * xy)
    long = mean + gap
    short = l11 * l22 * (l11 * l22) / long
    new_long, new_short = tl.maximum(long, least), tl.maximum(short, least)
    isotropic, minor = new_long - long, (new_short - short) - (new_long - long)
    divisor = tl.where(gap > 0.0, gap, 1.0)
    w11 = tl.sqrt(xx + isotropic + 0.5 * minor * (1.0 - half / divisor))
    w21, w22 = (xy - 0.5 * minor * (xy / divisor)) / w11, tl.sqrt(new_long * new_short) / w11
    is_thin = short < least
    return tl.where(is_thin, w11, l11), tl.where(is_thin, w21, l21), tl.where(is_thin, w22, l22)


@triton.jit
def _store(table, place, value, mask):
    """Write the numbers that are finite in float32."""
    value = value.to(tl.float32)
    tl.store(table + place, value, mask=mask & (tl.abs(value) < float("inf")))


@triton.jit
def _add(table, place, change, mask):
    _store(table, place, tl.load(table + place, mask=mask, other=0.0) + change, mask)


@triton_function(warps=4)
def _step(
    means, cholesky, colors, opacities, means_gradient, cholesky_gradient, colors_gradient, opacities_gradient,
    lr, beta1, beta2, eps, age, average, square,
    color_lr, color_beta1, color_beta2, color_eps, color_age, color_average, color_square,
    max_step, height, width, min_sigma, min_factor, max_outside, max_factor, count,
    CHANNELS: tl.constexpr, COLUMNS: tl.constexpr, MEANS: tl.constexpr, CHOLESKY: tl.constexpr, COLORS: tl.constexpr,
    OPACITIES: tl.constexpr, LR_LOADED: tl.constexpr, COLOR_LR_LOADED: tl.constexpr,
):  # fmt: skip
    """Step the colours, then the geometry; the arguments are those of `step`, and a launch takes them one by one."""
    row = tl.program_id(0).to(tl.int64) * _ROWS + tl.arange(0, _ROWS)
    mask = row < count
    gx = _gradient(means_gradient, 2 * row, mask, MEANS)
    gy = _gradient(means_gradient, 2 * row + 1, mask, MEANS)
    g11 = _gradient(cholesky_gradient, 3 * row, mask, CHOLESKY)
    g21 = _gradient(cholesky_gradient, 3 * row + 1, mask, CHOLESKY)
    g22 = _gradient(cholesky_gradient, 3 * row + 2, mask, CHOLESKY)
    largest = tl.abs(gx) + tl.abs(gy) + tl.abs(g11) + tl.abs(g21) + tl.abs(g22)
    if COLORS:
        for k in range(CHANNELS):
            largest += tl.abs(_gradient(colors_gradient, row * CHANNELS + k, mask, COLORS))
    largest += tl.abs(_gradient(opacities_gradient, row, mask, OPACITIES))
    mask = mask & (largest < float("inf"))

    if COLORS or OPACITIES:
        mask, rate, root = _count_step(color_age, row, mask, color_lr, color_beta1, color_beta2, COLOR_LR_LOADED)
        settings = color_average, color_square, rate, root, color_beta1, color_beta2, color_eps
        for k in range(COLUMNS):
            is_color = mask & (k < CHANNELS)
            gradient = _gradient(colors_gradient, row * CHANNELS + k, is_color, COLORS)
            gradient += _gradient(opacities_gradient, row, mask & (k >= CHANNELS), OPACITIES)
            change = _adam(gradient, row * COLUMNS + k, mask, settings)
            if COLORS:
                _add(colors, row * CHANNELS + k, change, is_color)
            if OPACITIES:
                _add(opacities, row, change, mask & (k >= CHANNELS))

    if MEANS or CHOLESKY:
        l11 = tl.load(cholesky + 3 * row, mask=mask, other=1.0).to(tl.float64)
        l21 = tl.load(cholesky + 3 * row + 1, mask=mask, other=0.0).to(tl.float64)
        l22 = tl.load(cholesky + 3 * row + 2, mask=mask, other=1.0).to(tl.float64)
        mask, rate, root = _count_step(age, row, mask, lr, beta1, beta2, LR_LOADED)
        settings = average, square, rate, root, beta1, beta2, eps
        # frame.local_gradient
        d1 = _clamp(_adam(l11 * gx + l21 * gy, 5 * row, mask, settings), -max_step, max_step)
        d2 = _clamp(_adam(l22 * gy, 5 * row + 1, mask, settings), -max_step, max_step)
        k11 = _clamp(_adam(l11 * g11 + l21 * g21, 5 * row + 2, mask, settings), -max_step, max_step)
        k21 = _clamp(_adam(l22 * g21, 5 * row + 3, mask, settings), -max_step, max_step)
        k22 = _clamp(_adam(l22 * g22, 5 * row + 4, mask, settings), -max_step, max_step)
        # frame.move, then adam.within_bounds
        shift_x, shift_y = l11 * d1, l21 * d1 + l22 * d2
        e1, e2, gap = tl.exp(k11), tl.exp(k22), k11 - k22
        is_small = tl.abs(gap) < 1e-4
        mean = tl.where(is_small, 0.5 * (e1 + e2), (e1 - e2) / tl.where(is_small, 1.0, gap))
        l21 = _clamp(l21 * e1 + l22 * k21 * mean, -max_factor, max_factor)
        l11, l22 = _clamp(l11 * e1, min_factor, max_factor), _clamp(l22 * e2, min_factor, max_factor)
        if MEANS:
            outside_x, outside_y = max_outside * l11, max_outside * tl.sqrt(l21 * l21 + l22 * l22)
            x = tl.load(means + 2 * row, mask=mask, other=0.0) + shift_x
            y = tl.load(means + 2 * row + 1, mask=mask, other=0.0) + shift_y
            _store(means, 2 * row, _clamp(x, -outside_x, width + outside_x), mask)
            _store(means, 2 * row + 1, _clamp(y, -outside_y, height + outside_y), mask)
        if CHOLESKY:
            l11, l21, l22 = _widen(l11, l21, l22, min_sigma)
            _store(cholesky, 3 * row, l11, mask)
            _store(cholesky, 3 * row + 1, l21, mask)
            _store(cholesky, 3 * row + 2, l22, mask)
