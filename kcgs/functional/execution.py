"""The execution of the operator: it prepares Gaussians and map for a kernel, which renders and differentiates.

Everything here is below autograd. Values are checked here, since a traced function does not see them; the public
function checks shapes.
"""

from __future__ import annotations

from typing import Any, NamedTuple, NoReturn

import torch
from torch import Tensor

from kcgs._torch_internals import with_autograd
from kcgs.kernels import Kernel, SplatInputs, resolve
from kcgs.maps import MapTable, RegionMap, positions_of, table_and_size, with_positions

from .arguments import SplatArguments
from .values import check_region_ids, check_values


class Execution(NamedTuple):
    """A kernel, its inputs, and its plan for them: a forward leaves all three for its backward."""

    kernel: Kernel
    inputs: SplatInputs
    plan: Any  # in the kernel's own format


def prepare(arguments: SplatArguments, check: bool = True) -> Execution:
    """Prepare Gaussians and map for the kernel that the backend names, and `check` their values."""
    inputs, kernel = _make_inputs(arguments, check)
    plan = kernel.plan(inputs)
    if plan is None:
        _refuse(arguments, inputs)
    if check and kernel.looks_up_regions and plan.num_unknown_ids:
        _check_ids(inputs)
    return Execution(kernel, inputs, plan)


def _refuse(arguments: SplatArguments, inputs: SplatInputs) -> NoReturn:
    """Raise the error of the value for which a kernel returned no plan."""
    check_values(*arguments[:3])
    _check_ids(inputs)
    raise AssertionError("bug: a kernel made no plan for valid inputs")


def render(arguments: SplatArguments, execution: Execution) -> Tensor:
    """Return the image, with B where the Gaussians have it."""
    image = execution.kernel.render(execution.plan, execution.inputs).contiguous()
    return image if image.ndim == arguments.means.ndim + 1 else image.squeeze(0)


def differentiate(
    arguments: SplatArguments, execution: Execution, grad: Tensor, geometry: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the gradients of means, cholesky and colors; without `geometry` the first two are empty."""
    inputs = execution.inputs
    if grad.ndim < inputs.means.ndim + 1:
        grad = grad.unsqueeze(0)
    gradients = execution.kernel.differentiate(execution.plan, inputs, grad, geometry)
    means, cholesky, colors = [gradients[2].new_empty(0) if g is None else g.contiguous() for g in gradients]
    if colors.ndim == arguments.colors.ndim:
        return means, cholesky, colors
    return means.squeeze(0), cholesky.squeeze(0), colors.squeeze(0)


def squared_error_gradients(
    image: Tensor,
    means: Tensor,
    cholesky: Tensor,
    colors: Tensor,
    region_ids: Tensor | None,
    regions: RegionMap | None,
    *,
    cutoff: float,
    backend: str,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the gradients of half the squared error of a render, summed over the pixels of an image, (..., C, H, W).

    It is for descents: one pass over the image where the backend can, without a graph and without checks of shapes.
    """
    table = None if regions is None else table_and_size(regions)[0]
    gaussians, size = (means.detach(), cholesky.detach(), colors.detach()), (image.shape[-2], image.shape[-1])
    arguments = SplatArguments(*gaussians, region_ids, table, size, cutoff, backend)
    execution = prepare(arguments)
    kernel, inputs, plan = execution
    if kernel.error_gradients is None:
        return differentiate(arguments, execution, render(arguments, execution) - image, True)
    of_means, of_cholesky, of_colors = kernel.error_gradients(plan, inputs, image)
    assert of_means is not None and of_cholesky is not None
    return of_means, of_cholesky, of_colors


def differentiate_twice(
    tangents: tuple[Tensor, Tensor, Tensor], grad: Tensor, arguments: SplatArguments
) -> tuple[Tensor, ...]:
    """Differentiate the scalar product of gradients and `tangents` by the image's gradient and by the Gaussians."""
    with with_autograd():
        image, leaves = _image_with_graph(arguments)
        leaves = [grad.detach().requires_grad_(), *leaves]
        first = torch.autograd.grad(image, leaves[1:], leaves[0], create_graph=True)
        # without geometry the tangents of means and factors are empty
        pairs = [(value, tangent) for value, tangent in zip(first, tangents, strict=True) if len(tangent)]
        values, weights = zip(*pairs, strict=True)
        second = torch.autograd.grad(values, leaves, weights, allow_unused=True, materialize_grads=True)
    return tuple(t.contiguous() for t in second)


def differentiate_forward(tangents: tuple[Tensor, Tensor, Tensor], arguments: SplatArguments) -> Tensor:
    """Differentiate the image along a change of the Gaussians."""
    with with_autograd():
        image, leaves = _image_with_graph(arguments)
        # the gradients are linear in `grad`: their derivative by `grad` is the forward derivative
        grad = torch.zeros_like(image, requires_grad=True)
        first = torch.autograd.grad(image, leaves, grad, create_graph=True)
        (derivative,) = torch.autograd.grad(first, grad, tangents)
    return derivative.contiguous()


def _image_with_graph(arguments: SplatArguments) -> tuple[Tensor, list[Tensor]]:
    """Render with a graph; return the image and the graph's leaves."""
    inputs, kernel = _make_inputs(arguments, check=False)
    if kernel.image is None:
        raise RuntimeError(
            f"backend {arguments.backend!r} has first derivatives by backward only: backend 'reference' has all"
        )
    leaves = [t.detach().requires_grad_() for t in arguments[:3]]
    image = kernel.image(SplatInputs(leaves[0], leaves[1], leaves[2], *inputs[3:]).with_batch())
    return image if arguments.means.ndim == 3 else image.squeeze(0), leaves


def _make_inputs(arguments: SplatArguments, check: bool) -> tuple[SplatInputs, Kernel]:
    """Return the inputs of the kernel, and the kernel."""
    table = region_ids = None
    if arguments.table is not None and arguments.region_ids is not None:
        table, region_ids = with_positions(arguments.table), arguments.region_ids.contiguous()
    inputs = SplatInputs(*arguments[:3], None, table, arguments.size, arguments.cutoff, region_ids)
    kernel = resolve(arguments.backend, inputs)
    if not kernel.looks_up_regions:
        inputs = _look_up(inputs, check)
    if check and not kernel.checks_values:
        check_values(*arguments[:3])
    return inputs if kernel.takes_one_image else inputs.with_batch(), kernel


def _look_up(inputs: SplatInputs, check: bool) -> SplatInputs:
    """Replace the ids of regions by their positions."""
    if inputs.table is None or inputs.region_ids is None:
        return inputs
    positions = _positions(inputs.region_ids, inputs.table)
    known = positions.device.type == "cpu" and int(positions.numpy().min(initial=0)) >= 0
    if check and not known:
        check_region_ids(inputs.region_ids, positions)
    # one region covers everything, and holds all Gaussians: no map is needed
    if inputs.table.num_regions == 1 and known:
        return inputs._replace(table=None, region_ids=None)
    return inputs._replace(region_positions=positions, region_ids=None)


def _check_ids(inputs: SplatInputs) -> None:
    """Refuse negative region ids, and warn of ids that the map does not hold."""
    if inputs.table is not None and inputs.region_ids is not None:
        check_region_ids(inputs.region_ids, _positions(inputs.region_ids, inputs.table))


def _positions(region_ids: Tensor, table: MapTable) -> Tensor:
    """Return the position of each Gaussian's region among the ids of the map, (B, N)."""
    assert table.ids is not None
    return positions_of(region_ids if region_ids.ndim == 2 else region_ids[None], table.ids)
