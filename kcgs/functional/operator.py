"""`kcgs::region_splat`, the operator that tools see: shapes, gradient, vmap, and which kernel evaluates it.

All enters as tensors and numbers. What is derived from the labels of a RegionMap is kept on their tensor; other labels
are converted at each call. A forward's plan for its backward is kept on autograd's context. Neither is traced. Values
are checked here, shapes by the public function.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch._functorch.utils import enable_single_level_autograd_function
from torch.autograd import forward_ad

from kcgs._check import check_labels
from kcgs.kernels import OutOfRangeError, SplatInputs, Steps, resolve, with_autograd

from .arguments import Arguments, KeptPlan, plans
from .map_tables import MapTables, keep_tables, tables_by_size
from .regions import RegionMap
from .softness import is_crisp, softness_of
from .values import check_id_values, check_values

_ARGUMENTS = (
    "Tensor means, Tensor cholesky, Tensor colors, Tensor? region_ids, Tensor? labels, Tensor? widths, "
    "SymInt height, SymInt width, float cutoff, str backend"
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


# The operator


def _render(*arguments: Any) -> Tensor:
    given = Arguments(*arguments)
    inputs, steps = _prepare(given)
    try:
        plan = steps.plan(inputs)
    except OutOfRangeError:
        check_values(*given[:3])
        raise
    if plans.wanted:
        plans.kept = KeptPlan(given, inputs, steps, plan)
    image = steps.render(plan, inputs).contiguous()
    return image if image.ndim == given.means.ndim + 1 else image.squeeze(0)


def _differentiate(grad: Tensor, *arguments: Any) -> tuple[Tensor, Tensor, Tensor]:
    given, geometry = Arguments(*arguments[:-1]), arguments[-1]
    kept, plans.kept = plans.kept, None
    if kept is not None and kept.is_of(given):
        _, inputs, steps, plan = kept
    else:
        inputs, steps = _prepare(given, checked=True)
        plan = steps.plan(inputs)
    if grad.ndim < inputs.means.ndim + 1:
        grad = grad.unsqueeze(0)
    found = steps.differentiate(plan, inputs, grad, geometry)
    means, cholesky, colors = [found[2].new_empty(0) if t is None else t.contiguous() for t in found]
    if colors.ndim == given.colors.ndim:
        return means, cholesky, colors
    if geometry:
        means, cholesky = means.squeeze(0), cholesky.squeeze(0)
    return means, cholesky, colors.squeeze(0)


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
    size, membership, index = (given.height, given.width), None, None
    if given.labels is not None and given.region_ids is not None:
        tables = _tables(given.labels, given.widths, size)
        index = tables.index_of(given.region_ids if given.region_ids.ndim == 2 else given.region_ids.unsqueeze(0))
        # CUDA is not waited for
        least = int(index.numpy().min(initial=0)) if index.device.type == "cpu" else -1
        membership = tables.membership
        if not checked:
            check_id_values(given.region_ids, index, least, tables.whole)
        # one region covers everything: no map, but Gaussians of other ids still paint nothing
        if membership.num_regions == 1 and least >= 0:
            index, membership = None, None
    inputs = SplatInputs(given.means, given.cholesky, given.colors, index, membership, size, given.cutoff)
    steps = resolve(given.backend, inputs)
    if not (checked or steps.as_given):
        check_values(*given[:3])
    return inputs if steps.as_given else inputs.with_batch(), steps


def _tables(labels: Tensor, widths: Tensor | None, size: tuple[int, int]) -> MapTables:
    crisp, kept = is_crisp(widths), tables_by_size(labels)
    tables = None if kept is None else kept.get((*size, crisp))
    if tables is None:
        check_labels("regions", labels)
        softness, contours = (0.0, "crisp") if crisp else (softness_of(widths), "scaled")
        regions = RegionMap.from_labels(labels, softness).resize(size, contours)
        tables = regions.tables
        if kept is not None:
            keep_tables(labels, size, crisp, tables)
    return tables


_LIBRARY.impl("region_splat", _render, "CompositeExplicitAutograd")
_LIBRARY.impl("region_splat_backward", _differentiate, "CompositeExplicitAutograd")
_LIBRARY.impl("region_splat_second", _differentiate_again, "CompositeExplicitAutograd")
_LIBRARY.impl("region_splat_forward", _differentiate_forward, "CompositeExplicitAutograd")


def _render_shape(*arguments: Any) -> Tensor:
    given = Arguments(*arguments)
    return given.colors.new_empty(*given.colors.shape[:-2], given.colors.shape[-1], given.height, given.width)


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


# Derivatives


class _Splat(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> Tensor:
        plans.wanted, plans.kept = True, None
        try:
            image: Tensor = _inside(splat_operator, *arguments)
        finally:
            plans.wanted = False
        ctx.save_for_backward(*arguments[:3])
        ctx.save_for_forward(*arguments[:3])
        # a graph would not save what was made in inference mode, which ids and labels may be
        ctx.others, ctx.kept, plans.kept = arguments[3:], plans.kept, None
        return image

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> Tensor:
        saved = ctx.saved_tensors
        along = [torch.zeros_like(t) if v is None else v for v, t in zip(tangents[:3], saved, strict=True)]
        image: Tensor = _forward(*along, *saved, *ctx.others)
        return image

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        means, cholesky, colors = ctx.needs_input_grad[:3]
        plans.kept = ctx.kept
        try:
            operator = _backward if torch._C._are_functorch_transforms_active() else _differentiate_with_gradient
            found = operator(grad, *ctx.saved_tensors, *ctx.others, means or cholesky)
        finally:
            plans.kept = None
        if not torch._C._autograd._get_current_graph_task_keep_graph():
            ctx.kept = None  # as torch frees what is saved: a loss that is kept holds no plan
        return found[0] if means else None, found[1] if cholesky else None, found[2] if colors else None, *[None] * 7


class _SplatBackward(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, Tensor, Tensor]:
        ctx.save_for_backward(*arguments[:7])
        ctx.settings = arguments[7:]
        return _inside(_backward, *arguments)  # type: ignore[no-any-return]

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> Tensor:
        raise RuntimeError(
            "a gradient of region_splat has no forward derivative: take jacrev twice in place of hessian"
        )

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        needed = ctx.needs_input_grad[:4]
        second = _second(*grads, *ctx.saved_tensors, *ctx.settings)
        return (*(g if need else None for g, need in zip(second, needed, strict=True)), *[None] * 8)


def _image_with_graph(given: Arguments) -> tuple[Tensor, list[Tensor]]:
    """Render with a graph, and return its leaves, too."""
    inputs, steps = _prepare(given, checked=True)
    if steps.image is None:
        raise RuntimeError(
            f"backend {given.backend!r} has first derivatives by backward only: backend 'reference' has all"
        )
    with with_autograd():
        leaves = [t.detach().requires_grad_() for t in given[:3]]
        image = steps.image(SplatInputs(leaves[0], leaves[1], leaves[2], *inputs[3:]).with_batch())
        return image if given.means.ndim == 3 else image.squeeze(0), leaves


def _differentiable(function: Any, *arguments: Any) -> Any:
    """Apply a function whose forward is the operator itself, inside of transforms of torch.func too."""
    if torch._C._are_functorch_transforms_active():
        with enable_single_level_autograd_function():
            return super(torch.autograd.Function, function).apply(*arguments)
    return super(torch.autograd.Function, function).apply(*arguments)


def _inside(operator: Any, *arguments: Any) -> Any:
    """Evaluate the forward of a function, which records nothing; levels of torch.func around it go on recording."""
    if not torch._C._are_functorch_transforms_active():
        return _below_autograd(operator, *arguments)
    with torch.enable_grad():
        return _below_autograd(operator, *arguments)


def _below_autograd(operator: Any, *arguments: Any) -> Any:
    with torch._C._AutoDispatchBelowAutograd():
        return operator(*arguments)


def _is_differentiated(tensors: tuple[Tensor, ...]) -> bool:
    return (torch.is_grad_enabled() and any([t.requires_grad for t in tensors])) or forward_ad._current_level >= 0


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


def _fold(info: Any, in_dims: tuple[int | None, ...], arguments: tuple[Any, ...], first: int) -> tuple[bool, list[Any]]:
    """Put the mapped dimension of every tensor into its batch; `first` is where the Gaussians begin.

    Returns, first, whether there was a batch.
    """
    means, labels, widths = first, first + 4, first + 5
    if in_dims[widths] is not None:
        raise ValueError("widths of contours cannot be mapped over: give the images as a batch")

    def over(k: int) -> Tensor:
        tensor, dim = arguments[k], in_dims[k]
        moved: Tensor = tensor.expand(info.batch_size, *tensor.shape) if dim is None else tensor.movedim(dim, 0)
        return moved

    folded = list(arguments)
    batched = over(means).ndim == 4
    for k in range(labels):
        if arguments[k] is not None:
            folded[k] = over(k).flatten(0, 1) if batched else over(k)
    given = arguments[labels]
    # a map that all images share stays as it is
    if given is not None and (in_dims[labels] is not None or (given.ndim == 3 and given.shape[0] > 1)):
        maps = over(labels)
        maps = maps[:, None] if maps.ndim == 3 else maps
        folded[labels] = maps.expand(-1, over(means).shape[1] if batched else 1, -1, -1).flatten(0, 1)
    return batched, folded


def _render_mapped(info: Any, in_dims: tuple[int | None, ...], *arguments: Any) -> tuple[Tensor, int]:
    batched, folded = _fold(info, in_dims, arguments, 0)
    image = splat_operator(*folded)
    return image.unflatten(0, (info.batch_size, -1)) if batched else image, 0


def _differentiate_mapped(
    info: Any, in_dims: tuple[int | None, ...], *arguments: Any
) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
    batched, folded = _fold(info, in_dims, arguments, 1)
    gradients = _backward(*folded)
    return tuple(g.unflatten(0, (info.batch_size, -1)) if batched else g for g in gradients), (0, 0, 0)


for _name, _shape in (
    ("region_splat", _render_shape),
    ("region_splat_backward", _gradient_shapes),
    ("region_splat_second", _second_shapes),
    ("region_splat_forward", lambda *arguments: _render_shape(*arguments[3:])),
):
    torch.library.register_fake(f"kcgs::{_name}", _shape, lib=_LIBRARY)
# fake tensors of open sizes prefer a decomposition where this table has nothing, and torch.onnx.export is given one
torch._decomp.register_decomposition(splat_operator, type="meta")(_render_shape)
torch.library.register_vmap("kcgs::region_splat", _render_mapped, lib=_LIBRARY)
torch.library.register_vmap("kcgs::region_splat_backward", _differentiate_mapped, lib=_LIBRARY)
