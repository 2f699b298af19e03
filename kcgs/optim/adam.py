"""The step of Adam in each Gaussian's own frame: by torch operations, compiled loops, or a Triton program.

A step takes the gradient to the frame (`frame.local_gradient`), updates Adam's averages, limits Adam's step to
`max_step`, takes it (`frame.move`), and brings the Gaussians `within_bounds`. Colours take Adam's step as it is.
`loops` and `cuda` have the same formulas in numba and in Triton; tests compare both with this module in float64.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.autograd.graph import increment_version

from kcgs._check import verify
from kcgs.errors import InvalidArgument
from kcgs.kernels import takes_triton

from .frame import local_gradient, move, widen
from .settings import Adam, Bounds

# least rows of geometry per task, and rows for which another thread is woken
_TASK_ROWS = 512
_THREAD_ROWS = 2048
# pixels: factors are at least this before they are widened, so that their squares are far from underflow
_MIN_FACTOR = 0.1
# age of a frozen row; loops and programs take every row of negative age as frozen
FROZEN = -1.0
# standard deviations by which a centre may lie outside the image, where fields are not bounded
_MAX_OUTSIDE = 2.0
# of the colours of bounded fields
COLOR_RANGE = (-1.0, 2.0)


def step_groups(state: dict[Tensor, Any], geometry: dict[str, Any], colors: dict[str, Any]) -> None:
    """Move the Gaussians of one field by the state of the optimizer and the field's two groups."""
    groups = [group for group in (geometry, colors) if _has_gradient(group)]
    for group in groups:
        init_state(state[group["params"][0]], group)
    parameters = geometry["params"] + colors["params"]
    if takes_triton(*parameters):
        _launch(state, geometry, colors)
    else:
        finite = None if _checks_gradients(parameters[0]) else _finite_rows(parameters)
        for group in groups:
            step = _step_geometry if group is geometry else _step_colors
            step(state[group["params"][0]], group, finite)
    table = colors["params"][0]
    if colors["bounded"] and table.requires_grad:
        table.clamp_(*COLOR_RANGE)


def _step_colors(state: dict[str, Tensor], group: dict[str, Any], finite: Tensor | None) -> None:
    colors, *opacities = group["params"]
    # a copy of a frozen table takes its steps
    tables = [table if table.requires_grad else table.clone() for table in (colors, *opacities)]
    tables = [tables[0], *(alpha[..., None] for alpha in tables[1:])]
    gradients = [_gradient(colors), *(_gradient(alpha)[..., None] for alpha in opacities)]
    gradient = torch.cat(gradients, -1) if opacities else gradients[0]
    if _is_compiled(*tables, *state.values()):
        from . import loops  # loads numba

        loops.step_tables(tuple(_rows(*tables)), *_rows(gradient), Adam(*_settings(group), *_averages(state)))
        increment_version([parameter for parameter in group["params"] if parameter.requires_grad])
        return
    moving = _moving_rows(state["age"], finite)
    change = _adam(state, gradient, group, moving)
    for table, part in zip(tables, change.split([table.shape[-1] for table in tables], -1), strict=True):
        _write(table, table + part, moving)


def _step_geometry(state: dict[str, Tensor], group: dict[str, Any], finite: Tensor | None) -> None:
    means, cholesky = group["params"]
    gradients = [_gradient(means), _gradient(cholesky)]
    if _is_compiled(means, cholesky, *state.values()):
        from kcgs.compiled.tasks import ranges, run_tasks

        from . import loops  # loads numba

        moves = means.requires_grad, cholesky.requires_grad
        adam = Adam(*_settings(group), *_averages(state))
        tables = tuple(_rows(means, cholesky))
        loop = partial(loops.step_geometry, tables, tuple(_rows(*gradients)), moves, adam, bounds_of(group))
        run_tasks(loop, ranges(len(tables[0]), _TASK_ROWS), len(tables[0]), _THREAD_ROWS)
        increment_version([parameter for parameter in group["params"] if parameter.requires_grad])
        return
    moving = _moving_rows(state["age"], finite)
    step = _adam(state, local_gradient(cholesky, *gradients), group, moving)
    step = step.clamp(-group["max_step"], group["max_step"])
    moved = within_bounds(*move(means, cholesky, step), bounds_of(group))
    for parameter, values in zip((means, cholesky), moved, strict=True):
        if parameter.requires_grad:  # a frozen parameter is not even brought within bounds
            _write(parameter, values, moving)


def _launch(state: dict[Tensor, Any], geometry: dict[str, Any], colors: dict[str, Any]) -> None:
    """Take the step of a field on a CUDA device, geometry and colours at once."""
    from . import cuda  # loads triton

    gradients, adams = [], []
    for group in (geometry, colors):
        moves, first = _has_gradient(group), group["params"][0]
        gradients += [_gradient(p).contiguous() if moves and p.requires_grad else None for p in group["params"]]
        # a group that does not move passes any address: it is not read
        averages = [state[first][name] if moves else first for name in ("age", "average", "square")]
        adams.append(Adam(*_settings(group), *averages))
    parameters = geometry["params"] + colors["params"]
    cuda.step(parameters, gradients, adams[0], adams[1], bounds_of(geometry))
    increment_version([p for p, gradient in zip(parameters, gradients, strict=True) if gradient is not None])


def bounds_of(group: dict[str, Any]) -> Bounds:
    """Return the bounds of a step of a field's geometry."""
    size = group["size"]
    max_outside, max_factor = (0.0, max(size)) if group["bounded"] else (_MAX_OUTSIDE, math.hypot(*size))
    limits = group["max_step"], *size, group["min_sigma"], _MIN_FACTOR, max_outside, max_factor
    return Bounds(*map(float, limits))


def _has_gradient(group: dict[str, Any]) -> bool:
    return any(parameter.grad is not None for parameter in group["params"])


def _checks_gradients(parameter: Tensor) -> bool:
    """Return whether gradients that are not finite are an error: only on the CPU, where a check does not wait."""
    return parameter.is_cpu


def _is_compiled(*tensors: Tensor) -> bool:
    """Return whether compiled loops may read and change the memory of tensors."""
    return not torch.compiler.is_compiling() and all(
        t.dtype is torch.float32 and t.is_cpu and t.is_contiguous() for t in tensors
    )


def _rows(*tensors: Tensor) -> list[Any]:
    """Return arrays (N, K) of tensors (..., N, K), in the same memory where that is contiguous."""
    return [t.detach().contiguous().numpy().reshape(-1, t.shape[-1]) for t in tensors]


def _settings(group: dict[str, Any]) -> list[Any]:
    """Return learning rate, betas and eps as floats; a rate on a device, which CUDA graphs read, stays there."""
    rate = group["lr"]
    on_device = isinstance(rate, Tensor) and not rate.is_cpu
    return [rate if on_device else float(rate), *map(float, (*group["betas"], group["eps"]))]


def _averages(state: dict[str, Tensor]) -> list[Any]:
    return _rows(state["age"], state["average"], state["square"])


def check_gradients(gradients: list[Tensor | None]) -> None:
    """Raise a ValueError for gradients on the CPU that are not finite."""
    tables = [gradient for gradient in gradients if gradient is not None and _checks_gradients(gradient)]
    if tables and _is_compiled(*tables) and is_within(tables, math.inf):
        return
    for gradient in tables:
        if not verify(gradient.isfinite().all(), "gradients must be finite"):
            count = int((~gradient.isfinite()).sum())
            cause = "the loss, or an operation between it and the render, is not finite"
            raise InvalidArgument("gradients", "finite", f"{count} NaN or infinite values: {cause}")


def is_within(tables: Sequence[Tensor], limit: float) -> bool:
    """Return whether the absolute value of every number in tables is below a limit, and none is NaN."""
    if not tables[0].is_cpu:
        return bool(torch.stack([(table.detach().abs() < limit).all() for table in tables]).all())
    # compiled: between renders, whose data fill the caches, an operation of torch takes thirty microseconds
    from . import loops  # loads numba

    return bool(loops.is_within(tuple(table.detach().numpy().ravel() for table in tables), limit))


def _gradient(parameter: Tensor) -> Tensor:
    return torch.zeros_like(parameter) if parameter.grad is None else parameter.grad


def state_shapes(group: dict[str, Any]) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the averages of a group, (..., N, K), by name; each row has an age of its own."""
    first, *others = group["params"]
    columns = 5 if group["kind"] == "geometry" else first.shape[-1] + len(others)
    return {name: (*first.shape[:-1], width) for name, width in (("age", 1), ("average", columns), ("square", columns))}


def init_state(state: dict[str, Tensor], group: dict[str, Any]) -> None:
    """Make the averages of a group, if there are none."""
    if not state:
        state.update({name: group["params"][0].new_zeros(shape) for name, shape in state_shapes(group).items()})


def _adam(state: dict[str, Tensor], gradient: Tensor, group: dict[str, Any], moving: Tensor | None) -> Tensor:
    """Update the averages of a table (..., N, K), in rows that move, and return Adam's step."""
    beta1, beta2 = group["betas"]
    previous = [] if moving is None else [values.clone() for values in state.values()]
    age, average, square = state["age"], state["average"], state["square"]
    age += 1
    average.lerp_(gradient, 1 - beta1)
    square.mul_(beta2).addcmul_(gradient, gradient, value=1 - beta2)
    scale = (square / (1 - beta2**age)).sqrt_().add_(group["eps"])
    step: Tensor = average / (1 - beta1**age) / scale * -group["lr"]
    if moving is not None:
        for values, old in zip(state.values(), previous, strict=True):
            values.copy_(torch.where(moving, values, old))
    return step


def _finite_rows(parameters: list[Tensor]) -> Tensor:
    """Return a mask of the Gaussians whose gradients are finite, (..., N, 1)."""
    means, *others = (_gradient(parameter) for parameter in parameters)
    tables = [means, *(table if table.ndim == means.ndim else table[..., None] for table in others)]
    return torch.cat(tables, -1).isfinite().all(-1, keepdim=True)


def _moving_rows(age: Tensor, finite: Tensor | None) -> Tensor | None:
    """Return a mask of the Gaussians with finite gradients that are not frozen, (..., N, 1); None: all move."""
    if finite is not None:
        return finite & (age >= 0)
    return age >= 0 if bool((age < 0).any()) else None


def _write(table: Tensor, values: Tensor, moving: Tensor | None) -> None:
    """Put values into a table, (..., N, K); with a mask, in rows that move, where the values are finite."""
    table.copy_(values if moving is None else torch.where(moving & values.isfinite(), values, table))


def within_bounds(means: Tensor, cholesky: Tensor, bounds: Bounds) -> tuple[Tensor, Tensor]:
    """Move centres back to the image or near it, and make Gaussians neither too thin nor larger than the image."""
    low, high = bounds.min_factor, bounds.max_factor
    l11, l21, l22 = cholesky.unbind(-1)
    l11, l21, l22 = l11.clamp(low, high), l21.clamp(-high, high), l22.clamp(low, high)
    # no tensor of the size: its copy to a device would force a host sync
    reaches = (bounds.max_outside * l11, bounds.max_outside * torch.hypot(l21, l22))
    lengths = (bounds.width, bounds.height)
    places = [
        torch.minimum(torch.maximum(place, -reach), reach + length)
        for place, reach, length in zip(means.unbind(-1), reaches, lengths, strict=True)
    ]
    return torch.stack(places, -1), widen(torch.stack([l11, l21, l22], -1), bounds.min_sigma)
