"""`kcgs::region_splat`, the operator that tools see: shapes, gradient, vmap, and which kernel evaluates it.

All enters as tensors and numbers. What is derived from a label map, and what a forward leaves for its backward, is kept
beside the tensors that it belongs to, and never traced. Values are checked here, shapes by the public function.
"""

from __future__ import annotations

import warnings
import weakref
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch._functorch.utils import enable_single_level_autograd_function
from torch.autograd import forward_ad
from torch.utils.weak import WeakIdKeyDictionary

from kcgs.kernels import SplatInputs, Steps, resolve, with_autograd

from .map_tables import MapTables, find_tables, keep_tables
from .regions import RegionMap
from .softness import softness_of
from .values import check_values

_ARGUMENTS = (
    "Tensor means, Tensor cholesky, Tensor colors, Tensor? region_ids, Tensor? labels, Tensor? widths, "
    "int supersample, SymInt height, SymInt width, float cutoff, str backend"
)
_LIBRARY = torch.library.Library("kcgs", "DEF")
_LIBRARY.define(f"region_splat({_ARGUMENTS}) -> Tensor")
_BACKWARD = f"Tensor grad, {_ARGUMENTS}, bool geometry"
_LIBRARY.define(f"region_splat_backward({_BACKWARD}) -> (Tensor, Tensor, Tensor)")
_LIBRARY.define(
    f"region_splat_second(Tensor by_means, Tensor by_cholesky, Tensor by_colors, {_BACKWARD}) "
    "-> (Tensor, Tensor, Tensor, Tensor)"
)
_LIBRARY.define(
    f"region_splat_forward(Tensor along_means, Tensor along_cholesky, Tensor along_colors, {_ARGUMENTS}) -> Tensor"
)

# as Python calls it
splat_operator: Any = torch.ops.kcgs.region_splat.default
_backward: Any = torch.ops.kcgs.region_splat_backward.default
_second: Any = torch.ops.kcgs.region_splat_second.default
_forward: Any = torch.ops.kcgs.region_splat_forward.default


class Arguments(NamedTuple):
    """Arguments of the operator; floating tensors share one dtype, float32 or float64."""

    means: Tensor  # [B, N, 2]
    cholesky: Tensor  # [B, N, 3]
    colors: Tensor  # [B, N, C]
    region_ids: Tensor | None  # [B, N] int64
    labels: Tensor | None  # [k * H, k * W] or [B, ...] int64; of the map at its own size, if that is another
    widths: Tensor | None  # [P, 3] float64: a pair of ids and its contour width; None: all are hard
    supersample: int  # k
    height: int
    width: int
    cutoff: float
    backend: str


# The operator


def _render(*arguments: Any) -> Tensor:
    given = Arguments(*arguments)
    inputs, steps = _prepare(given)
    plan = steps.plan(inputs)
    _keep_plan(given, plan)
    return steps.render(plan, inputs).contiguous()


def _differentiate(grad: Tensor, *arguments: Any) -> tuple[Tensor, Tensor, Tensor]:
    given, geometry = Arguments(*arguments[:-1]), arguments[-1]
    inputs, steps = _prepare(given, checked=True)
    plan = _take_plan(given)
    if plan is None:
        plan = steps.plan(inputs)
    means, cholesky, colors = steps.differentiate(plan, inputs, grad, geometry)
    found = (colors.new_empty(0) if t is None else t.contiguous() for t in (means, cholesky, colors))
    return tuple(found)  # type: ignore[return-value]


def _differentiate_again(*arguments: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Differentiate the backward by the gradient that it was given, and by the Gaussians."""
    weights, grad = arguments[:3], arguments[3]
    with with_autograd():
        image, leaves = _image_with_graph(Arguments(*arguments[4:-1]))
        leaves = [grad.detach().requires_grad_(), *leaves]
        first = torch.autograd.grad(image, leaves[1:], leaves[0], create_graph=True)
        # without geometry there were no gradients of it
        asked = [(value, weight) for value, weight in zip(first, weights, strict=True) if len(weight)]
        values, weights = zip(*asked, strict=True)
        found = torch.autograd.grad(values, leaves, weights, allow_unused=True, materialize_grads=True)
    return tuple(t.contiguous() for t in found)  # type: ignore[return-value]


def _differentiate_forward(*arguments: Any) -> Tensor:
    """Differentiate the image along a change of the Gaussians."""
    with with_autograd():
        image, leaves = _image_with_graph(Arguments(*arguments[3:]))
        # a gradient is linear in what it is asked for: differentiated by that, it is the derivative forward
        asked = torch.zeros_like(image, requires_grad=True)
        first = torch.autograd.grad(image, leaves, asked, create_graph=True)
        (found,) = torch.autograd.grad(first, asked, arguments[:3])
    return found.contiguous()


def _prepare(given: Arguments, checked: bool = False) -> tuple[SplatInputs, Steps]:
    """Return what a kernel takes, and the kernel."""
    if not checked:
        check_values(*given[:4])
    size, membership, index = (given.height, given.width), None, None
    if given.labels is not None and given.region_ids is not None:
        tables = _tables(given.labels, given.widths, given.supersample, size)
        index, membership = tables.index_of(given.region_ids), tables.membership
        if not checked and tables.whole and index.device.type == "cpu":
            _warn_of_strangers(index, given.region_ids)
        # one region covers everything: no map, but Gaussians of other ids still paint nothing
        if membership.num_regions == 1 and index.device.type == "cpu" and bool((index >= 0).all()):
            index, membership = None, None
    inputs = SplatInputs(*given[:3], index, membership, size, given.cutoff)
    return inputs, resolve(given.backend, inputs)


def _warn_of_strangers(index: Tensor, region_ids: Tensor) -> None:
    if index.numel() and int(index.min()) < 0:
        strangers = region_ids[index < 0]
        warnings.warn(
            f"{len(strangers)} of {index.numel()} Gaussians paint nothing: regions does not hold their region ids, "
            f"such as {int(strangers[0])}; pass the map that they belong to, or call field.assign_regions(regions)",
            stacklevel=2,
        )


def _tables(labels: Tensor, widths: Tensor | None, supersample: int, size: tuple[int, int]) -> MapTables:
    found = find_tables(labels, widths, supersample, size)
    if found is None:
        regions = RegionMap.from_labels(labels, softness_of(widths), supersample=supersample).resize(size)
        found = regions.tables
        keep_tables(labels, widths, supersample, size, found)
    return found


_LIBRARY.impl("region_splat", _render, "CompositeExplicitAutograd")
_LIBRARY.impl("region_splat_backward", _differentiate, "CompositeExplicitAutograd")
_LIBRARY.impl("region_splat_second", _differentiate_again, "CompositeExplicitAutograd")
_LIBRARY.impl("region_splat_forward", _differentiate_forward, "CompositeExplicitAutograd")


def _render_shape(*arguments: Any) -> Tensor:
    given = Arguments(*arguments)
    return given.colors.new_empty(given.colors.shape[0], given.colors.shape[-1], given.height, given.width)


def _gradient_shapes(grad: Tensor, *arguments: Any) -> tuple[Tensor, Tensor, Tensor]:
    given, geometry = Arguments(*arguments[:-1]), arguments[-1]
    shapes = [t.shape if geometry else (0,) for t in given[:2]]
    return (
        given.means.new_empty(shapes[0]),
        given.means.new_empty(shapes[1]),
        given.colors.new_empty(given.colors.shape),
    )


def _second_shapes(*arguments: Any) -> tuple[Tensor, ...]:
    return tuple(torch.empty_like(t, memory_format=torch.contiguous_format) for t in arguments[3:7])


# Plans: a forward leaves what it found for its backward


class _KeptPlan(NamedTuple):
    others: tuple[Any, ...]  # weak references to factors, colours, ids, labels and widths
    versions: tuple[int, ...]
    settings: tuple[Any, ...]
    plan: Any


_plans: WeakIdKeyDictionary = WeakIdKeyDictionary()


def _keep_plan(given: Arguments, plan: Any) -> None:
    if plan is not None and any(t.requires_grad for t in given[:3]):
        others = tuple(None if t is None else weakref.ref(t) for t in given[1:6])
        _plans[given.means] = _KeptPlan(others, _versions(given), given[6:], plan)


def _take_plan(given: Arguments) -> Any:
    kept = _plans.pop(given.means, None)
    if kept is None or kept.settings != given[6:] or kept.versions != _versions(given):
        return None
    same = all((None if ref is None else ref()) is t for ref, t in zip(kept.others, given[1:6], strict=True))
    return kept.plan if same else None


def _versions(given: Arguments) -> tuple[int, ...]:
    return tuple(-1 if t is None or t.is_inference() else t._version for t in given[:6])


# Derivatives


class _Splat(torch.autograd.Function):
    @staticmethod
    def forward(*arguments: Any) -> Tensor:
        return _below_autograd(splat_operator, *arguments)  # type: ignore[no-any-return]

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        # a graph does not save what was made in inference mode: ids and labels may be
        ctx.aside = [t if t is not None and t.is_inference() else None for t in inputs[:6]]
        saved = [t if aside is None else None for t, aside in zip(inputs, ctx.aside, strict=False)]
        ctx.save_for_backward(*saved)
        ctx.save_for_forward(*saved)
        ctx.settings = inputs[6:]

    @staticmethod
    def tensors(ctx: Any) -> list[Tensor | None]:
        return [t if aside is None else aside for t, aside in zip(ctx.saved_tensors, ctx.aside, strict=True)]

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> Tensor:
        tensors = _Splat.tensors(ctx)
        along = [torch.zeros_like(t) if v is None else v for v, t in zip(tangents[:3], tensors[:3], strict=True)]  # type: ignore[arg-type]
        image: Tensor = _forward(*along, *tensors, *ctx.settings)
        return image

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        needed = ctx.needs_input_grad[:3]
        gradients = _backward(grad, *_Splat.tensors(ctx), *ctx.settings, needed[0] or needed[1])
        return (*(g if need else None for g, need in zip(gradients, needed, strict=True)), *[None] * 8)


class _SplatBackward(torch.autograd.Function):
    @staticmethod
    def forward(*arguments: Any) -> tuple[Tensor, Tensor, Tensor]:
        return _below_autograd(_backward, *arguments)  # type: ignore[no-any-return]

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.save_for_backward(*inputs[:7])
        ctx.settings = inputs[7:]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        needed = ctx.needs_input_grad[:4]
        second = _second(*grads, *ctx.saved_tensors, *ctx.settings)
        return (*(g if need else None for g, need in zip(second, needed, strict=True)), *[None] * 9)


def _image_with_graph(given: Arguments) -> tuple[Tensor, list[Tensor]]:
    """Render with a graph, and return its leaves, too."""
    inputs, steps = _prepare(given, checked=True)
    if steps.image is None:
        raise RuntimeError(
            f"backend {given.backend!r} has first derivatives by backward only: backend 'reference' has all"
        )
    with with_autograd():
        leaves = [t.detach().requires_grad_() for t in given[:3]]
        return steps.image(inputs._replace(means=leaves[0], cholesky=leaves[1], colors=leaves[2])), leaves


def _differentiable(function: Any, *arguments: Any) -> Any:
    """Apply a function whose forward is the operator itself, inside of transforms of torch.func too."""
    if torch._C._are_functorch_transforms_active():
        with enable_single_level_autograd_function():
            return super(torch.autograd.Function, function).apply(*arguments)
    return super(torch.autograd.Function, function).apply(*arguments)


def _below_autograd(operator: Any, *arguments: Any) -> Any:
    with torch._C._AutoDispatchBelowAutograd():
        return operator(*arguments)


def _is_differentiated(tensors: tuple[Tensor, ...]) -> bool:
    return forward_ad._current_level >= 0 or (torch.is_grad_enabled() and any(t.requires_grad for t in tensors))


def _render_with_gradient(*arguments: Any) -> Any:
    if _is_differentiated(arguments[:3]):
        return _differentiable(_Splat, *arguments)
    return _below_autograd(splat_operator, *arguments)


def _differentiate_with_gradient(*arguments: Any) -> Any:
    if _is_differentiated(arguments[:4]):
        return _differentiable(_SplatBackward, *arguments)
    return _below_autograd(_backward, *arguments)


_LIBRARY.impl("region_splat", _render_with_gradient, "Autograd")
_LIBRARY.impl("region_splat_backward", _differentiate_with_gradient, "Autograd")
torch.library.register_autocast("kcgs::region_splat", "cpu", torch.float32, lib=_LIBRARY)
torch.library.register_autocast("kcgs::region_splat", "cuda", torch.float32, lib=_LIBRARY)


# vmap: more images in the batch


def _fold(info: Any, in_dims: tuple[int | None, ...], arguments: tuple[Any, ...], first: int) -> list[Any]:
    """Put the mapped dimension of every tensor into its batch; `first` is where the Gaussians begin."""
    means, labels, widths = first, first + 4, first + 5
    if in_dims[widths] is not None:
        raise ValueError("widths of contours cannot be mapped over: give the images as a batch")

    def over(k: int) -> Tensor:
        tensor, dim = arguments[k], in_dims[k]
        moved: Tensor = tensor.expand(info.batch_size, *tensor.shape) if dim is None else tensor.movedim(dim, 0)
        return moved

    folded = list(arguments)
    for k in range(labels):
        if arguments[k] is not None:
            folded[k] = over(k).flatten(0, 1)
    given = arguments[labels]
    # a map that all images share stays as it is
    if given is not None and (in_dims[labels] is not None or (given.ndim == 3 and given.shape[0] > 1)):
        maps = over(labels)
        maps = maps[:, None] if maps.ndim == 3 else maps
        folded[labels] = maps.expand(-1, over(means).shape[1], -1, -1).flatten(0, 1)
    return folded


def _render_mapped(info: Any, in_dims: tuple[int | None, ...], *arguments: Any) -> tuple[Tensor, int]:
    image = splat_operator(*_fold(info, in_dims, arguments, 0))
    return image.unflatten(0, (info.batch_size, -1)), 0


def _differentiate_mapped(
    info: Any, in_dims: tuple[int | None, ...], *arguments: Any
) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
    gradients = _backward(*_fold(info, in_dims, arguments, 1))
    return tuple(g.unflatten(0, (info.batch_size, -1)) for g in gradients), (0, 0, 0)


for _name, _shape in (
    ("region_splat", _render_shape),
    ("region_splat_backward", _gradient_shapes),
    ("region_splat_second", _second_shapes),
    ("region_splat_forward", lambda *arguments: _render_shape(*arguments[3:])),
):
    torch.library.register_fake(f"kcgs::{_name}", _shape, lib=_LIBRARY)
torch.library.register_vmap("kcgs::region_splat", _render_mapped, lib=_LIBRARY)
torch.library.register_vmap("kcgs::region_splat_backward", _differentiate_mapped, lib=_LIBRARY)
