"""`kcgs::region_splat`, the operator that torch's tools see: its schema, derivatives, shapes and vmap.

Its arguments are tensors and numbers; `execution` computes. A forward keeps its plan for its backward on autograd's
context. Compilers and transforms do not see the context: their backward plans again.
"""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor

from kcgs._torch_internals import (
    apply,
    below_autograd,
    forward_derivatives,
    has_mode,
    is_batched_gradient,
    is_forward_mode,
    is_graph_retained,
    is_transforming,
    register_decomposition,
)
from kcgs.maps import PER_MAP, SHARED, MapTable

from .arguments import NUM_ARGUMENTS, SCHEMA, TABLE_PLACE, SplatArguments
from .execution import Execution, differentiate, differentiate_forward, differentiate_twice, prepare, render

# number of arguments without a derivative
_NUM_CONSTANTS = NUM_ARGUMENTS - 3
_BACKWARD = f"Tensor grad, {SCHEMA}, bool geometry"
_TANGENTS = "Tensor d_means, Tensor d_cholesky, Tensor d_colors"
_LIBRARY = torch.library.Library("kcgs", "DEF")
_LIBRARY.define(f"region_splat({SCHEMA}) -> Tensor")
_LIBRARY.define(f"region_splat_backward({_BACKWARD}) -> (Tensor, Tensor, Tensor)")
_LIBRARY.define(f"region_splat_double_backward({_TANGENTS}, {_BACKWARD}) -> (Tensor, Tensor, Tensor, Tensor)")
_LIBRARY.define(f"region_splat_forward({_TANGENTS}, {SCHEMA}) -> Tensor")

_THIRD = "region_splat is differentiable twice: take vhp of torch.autograd.functional, not hvp, which needs a third"

# the operators, as Python calls them
splat_operator: Any = torch.ops.kcgs.region_splat.default
_backward_operator: Any = torch.ops.kcgs.region_splat_backward.default
_double_backward_operator: Any = torch.ops.kcgs.region_splat_double_backward.default
_forward_operator: Any = torch.ops.kcgs.region_splat_forward.default


# Derivatives: these functions run first where a gradient may be needed


def _differentiable(operator: Any, function: Any, num_tensors: int, *arguments: Any) -> Any:
    """Evaluate an operator by its autograd.Function if the first tensors need a derivative, else below autograd."""
    if _is_differentiated(arguments[:num_tensors]):
        return apply(function, *arguments)
    return below_autograd(operator, *arguments)


class _Splat(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> Tensor:
        image: Tensor
        if _is_plain(arguments[:3]):  # the plan cannot pass through the operator
            image, ctx.execution = below_autograd(_render, SplatArguments.of(*arguments))
        else:
            image, ctx.execution = _unrecorded(splat_operator, *arguments), None
        ctx.save_for_backward(*arguments[:3])
        ctx.save_for_forward(*arguments[:3])
        _keep_constants(ctx, arguments[3:])
        return image

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> Tensor:
        gaussians = ctx.saved_tensors
        image: Tensor = _forward_operator(*_filled(tangents[:3], gaussians), *gaussians, *_constants(ctx))
        return image

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        means, cholesky, colors = ctx.needs_input_grad[:3]
        gaussians, geometry = ctx.saved_tensors, means or cholesky
        if ctx.execution is not None and _is_plain((grad, *gaussians)) and not torch.is_grad_enabled():
            arguments = SplatArguments.of(*gaussians, *ctx.constants)
            gradients = below_autograd(differentiate, arguments, ctx.execution, grad, geometry)
        else:
            gradients = _backward_operator(grad, *gaussians, *_constants(ctx), geometry)
        if not is_graph_retained():
            ctx.execution = None  # torch frees saved tensors at this time: a loss that stays alive holds no plan
        needed = zip(gradients, (means, cholesky, colors), strict=True)
        return (*(g if need else None for g, need in needed), *[None] * _NUM_CONSTANTS)


class _SplatBackward(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, Tensor, Tensor]:
        ctx.save_for_backward(*arguments[:7])
        ctx.save_for_forward(*arguments[:7])
        ctx.constants = arguments[7:]
        return _unrecorded(_backward_operator, *arguments)  # type: ignore[no-any-return]

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> tuple[Tensor, ...]:
        arguments = ctx.saved_tensors
        d_grad, *d_gaussians = _filled(tangents[:4], arguments[:4])
        first = _backward_operator(d_grad, *arguments[1:], *ctx.constants)
        # second derivatives are symmetric: backward and forward are the same sum
        second = _double_backward_operator(*d_gaussians, *arguments, *ctx.constants)[1:]
        return tuple(a + b if len(a) else a for a, b in zip(first, second, strict=True))

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        second = _double_backward_operator(*grads, *ctx.saved_tensors, *ctx.constants)
        needed = zip(second, ctx.needs_input_grad[:4], strict=True)
        return (*(g if need else None for g, need in needed), *[None] * (_NUM_CONSTANTS + 1))


class _SplatForward(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> Tensor:
        ctx.save_for_backward(*arguments[:6])
        _keep_constants(ctx, arguments[6:])
        image: Tensor = _unrecorded(_forward_operator, *arguments)
        return image

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> Tensor:
        raise RuntimeError("region_splat is differentiable forward once: take jacrev of a jvp in place of its jvp")

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        tangents, gaussians = ctx.saved_tensors[:3], ctx.saved_tensors[3:]
        constants = _constants(ctx)
        first = _backward_operator(grad, *gaussians, *constants, True)
        second = _double_backward_operator(*tangents, grad, *gaussians, *constants, True)[1:]
        return (*first, *second, *[None] * _NUM_CONSTANTS)


class _SplatDoubleBackward(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, ...]:
        return _unrecorded(_double_backward_operator, *arguments)  # type: ignore[no-any-return]

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> tuple[Tensor, ...]:
        raise RuntimeError(_THIRD)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        raise RuntimeError(_THIRD)


def _keep_constants(ctx: Any, constants: tuple[Any, ...]) -> None:
    """Keep ids, labels and settings on the context; `save_for_backward` refuses tensors of inference mode."""
    ctx.constants, ctx.versions = constants, _versions(constants)


def _constants(ctx: Any) -> tuple[Any, ...]:
    """Return the constants; raise if ids or labels were written to since, as torch does for saved tensors."""
    constants: tuple[Any, ...] = ctx.constants
    for name, version, expected in zip(("region_ids", "regions"), _versions(constants), ctx.versions, strict=True):
        if version != expected:
            raise RuntimeError(
                "one of the variables needed for gradient computation has been modified by an inplace operation: "
                f"{name} of region_splat is at version {version}; expected version {expected} instead"
            )
    return constants


def _versions(constants: tuple[Any, ...]) -> list[int | None]:
    """Return how often ids and labels have been written to; None: torch does not count."""
    return [None if t is None or t.is_inference() else t._version for t in constants[:2]]


def _filled(tangents: tuple[Tensor | None, ...], tensors: tuple[Tensor, ...]) -> list[Tensor]:
    return [torch.zeros_like(t) if v is None else v for v, t in zip(tangents, tensors, strict=True)]


def _is_differentiated(tensors: tuple[Tensor, ...]) -> bool:
    return (torch.is_grad_enabled() and any([t.requires_grad for t in tensors])) or is_forward_mode()


def _is_plain(tensors: tuple[Tensor, ...]) -> bool:
    """Return whether no transform, mode or subclass of torch has to see the operator."""
    if is_transforming() or has_mode():
        return False
    return all(
        [type(t) in (Tensor, torch.nn.Parameter) and not t.is_meta and not is_batched_gradient(t) for t in tensors]
    )


def _unrecorded(operator: Any, *arguments: Any) -> Any:
    """Evaluate below autograd; outer levels of torch.func still record."""
    if not is_transforming():
        return below_autograd(operator, *arguments)
    with torch.enable_grad(), forward_derivatives():
        return below_autograd(operator, *arguments)


# Execution, below autograd


def _splat(*arguments: Any) -> Tensor:
    return _render(SplatArguments.of(*arguments))[0]


def _render(arguments: SplatArguments) -> tuple[Tensor, Execution]:
    execution = prepare(arguments)
    return render(arguments, execution), execution


def _splat_backward(grad: Tensor, *arguments: Any) -> tuple[Tensor, Tensor, Tensor]:
    gaussians = SplatArguments.of(*arguments[:-1])
    return differentiate(gaussians, prepare(gaussians, check=False), grad, arguments[-1])


def _splat_double_backward(*arguments: Any) -> tuple[Tensor, ...]:
    return differentiate_twice(arguments[:3], arguments[3], SplatArguments.of(*arguments[4:-1]))


def _splat_forward(*arguments: Any) -> Tensor:
    return differentiate_forward(arguments[:3], SplatArguments.of(*arguments[3:]))


# Shapes, for tensors without values


def _splat_shape(*arguments: Any) -> Tensor:
    splat = SplatArguments.of(*arguments)
    return splat.colors.new_empty(*splat.colors.shape[:-2], splat.colors.shape[-1], *splat.size)


def _backward_shapes(grad: Tensor, *arguments: Any) -> tuple[Tensor, Tensor, Tensor]:
    means, cholesky, colors, geometry = *arguments[:3], arguments[-1]
    return (
        means.new_empty(means.shape if geometry else (0,)),
        means.new_empty(cholesky.shape if geometry else (0,)),
        means.new_empty(colors.shape),
    )


def _double_backward_shapes(*arguments: Any) -> tuple[Tensor, ...]:
    return tuple(torch.empty_like(t, memory_format=torch.contiguous_format) for t in arguments[3:7])


def _forward_shape(*arguments: Any) -> Tensor:
    return _splat_shape(*arguments[3:])


# vmap: more images in the batch


def _splat_vmap(info: Any, in_dims: tuple[int | None, ...], *arguments: Any) -> tuple[Tensor, int]:
    batched, folded = _fold(info, in_dims, arguments, 0)
    image = splat_operator(*folded)
    return image.unflatten(0, (info.batch_size, -1)) if batched else image, 0


def _backward_vmap(
    info: Any, in_dims: tuple[int | None, ...], *arguments: Any
) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
    batched, folded = _fold(info, in_dims, arguments, 1)
    gradients = _backward_operator(*folded)
    return tuple(g.unflatten(0, (info.batch_size, -1)) if batched else g for g in gradients), (0, 0, 0)


def _fold(info: Any, in_dims: tuple[int | None, ...], arguments: tuple[Any, ...], first: int) -> tuple[bool, list[Any]]:
    """Fold the mapped dimension of every tensor into its batch; `first` is the place of the means.

    Returns whether there was a batch, and the arguments.
    """
    places = {name: k for k, name in enumerate(MapTable._fields, first + TABLE_PLACE)}
    labels = places["labels"]
    if any(in_dims[k] is not None for k in places.values() if k != labels):
        raise ValueError("a RegionMap cannot be mapped over: give the images as a batch")

    def mapped(k: int) -> Tensor:
        tensor, dim = arguments[k], in_dims[k]
        moved: Tensor = tensor.expand(info.batch_size, *tensor.shape) if dim is None else tensor.movedim(dim, 0)
        return moved

    folded = list(arguments)
    batched = mapped(first).ndim == 4
    for k in range(labels):
        if arguments[k] is not None:
            folded[k] = mapped(k).flatten(0, 1) if batched else mapped(k)
    maps = arguments[labels]
    # a map that all images share stays as it is
    if maps is not None and (in_dims[labels] is not None or (maps.ndim == 3 and maps.shape[0] > 1)):
        count = mapped(first).shape[1] if batched else 1

        def each(k: int) -> Tensor:
            part = mapped(k)
            part = part[:, None] if part.ndim == 3 else part
            return part.expand(-1, count, -1, -1).flatten(0, 1)

        for name, k in places.items():
            if name not in SHARED:  # the other fields depend on the number of maps, and are made anew
                folded[k] = each(k) if name in PER_MAP and arguments[k] is not None else None
    return batched, folded


# the last column is the number of first arguments by which an operator is differentiated
for _name, _evaluate, _shape, _function, _num_tensors in (
    ("region_splat", _splat, _splat_shape, _Splat, 3),
    ("region_splat_backward", _splat_backward, _backward_shapes, _SplatBackward, 4),
    ("region_splat_double_backward", _splat_double_backward, _double_backward_shapes, _SplatDoubleBackward, 7),
    ("region_splat_forward", _splat_forward, _forward_shape, _SplatForward, 6),
):
    _operator = getattr(torch.ops.kcgs, _name).default
    _LIBRARY.impl(_name, functools.partial(_differentiable, _operator, _function, _num_tensors), "Autograd")
    _LIBRARY.impl(_name, _evaluate, "CompositeExplicitAutograd")
    torch.library.register_fake(f"kcgs::{_name}", _shape, lib=_LIBRARY)
torch.library.register_vmap("kcgs::region_splat", _splat_vmap, lib=_LIBRARY)
torch.library.register_vmap("kcgs::region_splat_backward", _backward_vmap, lib=_LIBRARY)
for _device in ("cpu", "cuda"):
    torch.library.register_autocast("kcgs::region_splat", _device, torch.float32, lib=_LIBRARY)
register_decomposition(splat_operator, _splat_shape, "meta")
