"""Adam in each Gaussian's own frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.graph import increment_version
from torch.nn.functional import pad
from torch.optim import Optimizer

from kcgs._check import check_number, verify
from kcgs.errors import InvalidArgument, InvalidArgumentType
from kcgs.kernels import takes_triton
from kcgs.nn import GaussianField

from .frame import local_gradient, move, widen
from .settings import Adam, Bounds

# steps of place in standard deviations and of log scale, and steps of colours: found on photos, and good on all images
LEARNING_RATE = 0.14
COLOR_LEARNING_RATE = 0.03
# rows of geometry that one task moves, at least, and for which another thread is woken
_TASK_ROWS = 512
_THREAD_ROWS = 2048
# pixels: factors are at least this before they are widened, so that their squares are far from underflow
_MIN_FACTOR = 0.1
# age of a row that does not move; loops and programs take every negative one as such
_FROZEN = -1.0
# standard deviations by which a centre may lie outside the image
_MAX_OUTSIDE = 2.0


class GaussianAdam(Optimizer):
    r"""Adam in each Gaussian's own frame, so that one learning rate suits Gaussians of all sizes and all images.

    Convention: a step moves a centre by :math:`L d` and a factor to :math:`L \exp K`, with d and the lower triangular K
    taken by Adam, and colours as Adam does. Every step leaves a valid field: centres stay within two standard
    deviations of the image, standard deviations between `min_sigma` and the image's diagonal. A field has two parameter
    groups, its geometry and its colours, each with its own ``lr``, which torch's schedulers change.

    Args:
        fields: a GaussianField, or several; batched ones, too.
        lr: step of place in standard deviations, and of log scale. A tensor on the device of the fields is read at each
            replay of a CUDA graph.
        color_lr: step of colours and opacities.
        betas: of the averages of gradients and of their squares.
        eps: added to the root of the latter.
        min_sigma: least standard deviation, in pixels. Thinner Gaussians fit the pixels' centres better, and are dots
            and needles when a scene is enlarged.
        max_step: the largest step of place and of log scale.

    Raises:
        TypeError: something else than fields, or a setting that is no number.
        ValueError: a field that is a network's output, and so holds no parameters; a setting out of range.

    Example:
        >>> from kcgs import RegionSplatRenderer
        >>> field, image = GaussianField.random(20, (16, 24), seed=0), torch.linspace(0, 1, 24).expand(3, 16, 24)
        >>> optimizer, renderer = GaussianAdam(field), RegionSplatRenderer()
        >>> losses = []
        >>> for _ in range(50):
        ...     optimizer.zero_grad()
        ...     losses.append((renderer(field) - image).square().mean())
        ...     losses[-1].backward()
        ...     optimizer.step()
        >>> bool(losses[-1] < 0.05 * losses[0])
        True

    Source: Kingma and Ba, "Adam: A Method for Stochastic Optimization", 2015, in a Gaussian's own coordinates.
    """

    def __init__(
        self,
        fields: GaussianField | Iterable[GaussianField],
        lr: float | Tensor = LEARNING_RATE,
        *,
        color_lr: float | Tensor = COLOR_LEARNING_RATE,
        betas: tuple[float, float] = (0.9, 0.99),
        eps: float = 1e-12,
        min_sigma: float = 0.5,
        max_step: float = 0.5,
    ) -> None:
        for name, value in {"lr": lr, "color_lr": color_lr, "eps": eps, "min_sigma": min_sigma}.items():
            check_number(name, float(value) if isinstance(value, Tensor) else value, 0.0)
        check_number("max_step", max_step, 0.0, above=True)
        if not all(0 <= beta < 1 for beta in betas):
            raise InvalidArgument("betas", "in [0, 1)", betas)
        groups: list[dict[str, Any]] = []
        for field in [fields] if isinstance(fields, nn.Module) and not isinstance(fields, nn.ModuleList) else fields:
            if not isinstance(field, GaussianField):
                raise InvalidArgumentType("fields", "GaussianFields, such as scene.field", type(field).__name__)
            if len([*field.parameters()]) < 3 + (field.opacities is not None):
                received = "a network's output: give the network's parameters to an optimizer of torch"
                raise InvalidArgument("fields", "of parameters", received)
            geometry = [field.means, field.cholesky]
            colors = [field.colors] if field.opacities is None else [field.colors, field.opacities]
            groups.append({"kind": "geometry", "params": geometry, "lr": lr, "size": field.size})
            groups.append({"kind": "colors", "params": colors, "lr": color_lr})
        super().__init__(groups, {"betas": betas, "eps": eps, "min_sigma": min_sigma, "max_step": max_step})

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Move every Gaussian that has a gradient.

        Args:
            closure: evaluates the loss anew, and returns it.

        Raises:
            ValueError: a gradient that is not finite, on the CPU, before anything moves. On another device, which a
                step does not wait for, a Gaussian with such a gradient stays as it is.
        """
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        _check_gradients([parameter.grad for group in self.param_groups for parameter in group["params"]])
        for geometry, colors in zip(self.param_groups[::2], self.param_groups[1::2], strict=True):
            self._step_field(geometry, colors)
        return loss

    def _step_field(self, geometry: dict[str, Any], colors: dict[str, Any]) -> None:
        """Move the Gaussians of one field."""
        groups = [group for group in (geometry, colors) if _has_gradient(group)]
        for group in groups:
            _begin(self.state[group["params"][0]], group)
        parameters = geometry["params"] + colors["params"]
        if takes_triton(*parameters):
            _launch(self.state, geometry, colors)
            return
        finite = None if _raises(parameters[0]) else _finite_rows(parameters)
        for group in groups:
            step = _step_geometry if group is geometry else _step_colors
            step(self.state[group["params"][0]], group, finite)

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """Refuse groups that are no field's: torch calls this when the optimizer is made."""
        if "kind" not in param_group:
            expected = "a GaussianField's: train other parameters with an optimizer of their own"
            raise InvalidArgument("param_group", expected, f"one of {[*param_group]}")
        super().add_param_group(param_group)

    @torch.no_grad()
    def append(self, field: GaussianField, added: GaussianField) -> None:
        """Add the Gaussians of another field to one of the optimizer's; the averages of the others stay.

        Args:
            field: one that the optimizer was made for; it gets new parameters.
            added: of the same channels, both with region ids and opacities or neither.

        Raises:
            ValueError: a field that the optimizer was not made for, or one to which the Gaussians do not fit.
        """
        if _layout(field) != _layout(added):
            raise InvalidArgument("added", _layout(field), _layout(added), verb="have")
        min_sigma = self._group(field)["min_sigma"]
        means, cholesky = _bounded(added.means, added.cholesky, field.size, min_sigma)
        parts = {"means": means, "cholesky": cholesky, "colors": added.colors, "opacities": added.opacities}
        rows = means.ndim - 2
        for name, part in parts.items():
            if part is not None:
                self._replace(field, name, torch.cat([getattr(field, name), part], rows))
        if field.region_ids is not None and added.region_ids is not None:
            field.region_ids = torch.cat([field.region_ids, added.region_ids], rows)
        for state in self._states(field):
            state.update({name: pad(average, (0, 0, 0, added.num_gaussians)) for name, average in state.items()})

    @torch.no_grad()
    def keep(self, field: GaussianField, mask: Tensor) -> None:
        """Remove all Gaussians but those of a mask from one of the optimizer's fields.

        Args:
            field: one that the optimizer was made for; it gets new parameters.
            mask: boolean :math:`(N)`, for all images of a batch; or :math:`(B, N)`, with as many in each image.

        Raises:
            ValueError: a field that the optimizer was not made for; a mask of another type or shape, or of more
                Gaussians in one image than in another.
        """
        self._group(field)
        shapes = (field.means.shape[-2:-1], field.means.shape[:-1])
        if mask.dtype != torch.bool or mask.shape not in shapes:
            expected = " or ".join(f"({', '.join(map(str, shape))})" for shape in dict.fromkeys(shapes))
            raise InvalidArgument("mask", f"boolean, {expected}", f"{mask.dtype}, {tuple(mask.shape)}")
        index = mask.nonzero()[:, -1]
        if mask.ndim == 2:
            counts = mask.sum(1)
            if not bool((counts == counts[0]).all()):
                raise InvalidArgument("mask", "of as many Gaussians in each image", counts.tolist())
            index = index.view(len(mask), -1)
        for name in ("means", "cholesky", "colors", "opacities"):
            if (value := getattr(field, name)) is not None:
                self._replace(field, name, _select_rows(value, index, field.means.ndim - 2))
        if field.region_ids is not None:
            field.region_ids = _select_rows(field.region_ids, index, field.region_ids.ndim - 1)
        for state in self._states(field):
            rows = {name: _select_rows(average, index, average.ndim - 2) for name, average in state.items()}
            state.update(rows)

    @torch.no_grad()
    def freeze(self, field: GaussianField, mask: Tensor) -> None:
        """Leave Gaussians as they are from here on, whatever their gradients.

        Args:
            field: one that the optimizer was made for.
            mask: of these Gaussians, boolean, :math:`(N)` or :math:`(B, N)` as the field.

        Raises:
            ValueError: a field that the optimizer was not made for; a mask of another type or shape.

        Example:
            >>> field = GaussianField.random(4, (16, 24), seed=0)
            >>> optimizer = GaussianAdam(field)
            >>> optimizer.freeze(field, torch.tensor([True, False, False, False]))
            >>> field.colors.grad, before = torch.ones(4, 3), field.colors.detach().clone()
            >>> optimizer.step()
            >>> (field.colors != before).any(-1)
            tensor([False,  True,  True,  True])
        """
        geometry = self._group(field)
        expected = field.means.shape[:-1]
        if mask.dtype != torch.bool or mask.shape != expected:
            raise InvalidArgument("mask", f"boolean, {tuple(expected)}", f"{mask.dtype}, {tuple(mask.shape)}")
        colors = next(group for group in self.param_groups if group["params"][0] is field.colors)
        for group in (geometry, colors):
            state = self.state[group["params"][0]]
            _begin(state, group)
            state["age"].masked_fill_(mask[..., None], _FROZEN)

    def _group(self, field: GaussianField) -> dict[str, Any]:
        """Return the group of a field's geometry; ValueError for a field that the optimizer was not made for."""
        for group in self.param_groups:
            if group["params"][0] is field.means:
                return group
        raise InvalidArgument("field", "one that the optimizer was made for", "another")

    def _replace(self, field: GaussianField, name: str, rows: Tensor) -> None:
        """Put another parameter into the field, its group, and the state."""
        old = getattr(field, name)
        new = nn.Parameter(rows, old.requires_grad)
        setattr(field, name, new)
        for group in self.param_groups:
            group["params"] = [new if parameter is old else parameter for parameter in group["params"]]
        if old in self.state:
            self.state[new] = self.state.pop(old)

    def _states(self, field: GaussianField) -> Iterator[dict[str, Tensor]]:
        return (self.state[tensor] for tensor in (field.means, field.colors) if tensor in self.state)


def _select_rows(table: Tensor, index: Tensor, rows: int) -> Tensor:
    """Return rows of a table, whose dimension they are: (N',) for all images, or (B, N') for each."""
    if index.ndim == 1:
        return table.index_select(rows, index)
    columns = table.shape[2:]
    return table.gather(1, index.view(*index.shape, *[1] * len(columns)).expand(*index.shape, *columns))


def _layout(field: GaussianField) -> str:
    """Say what another field must have to fit to a field."""
    *batch, _, channels = field.colors.shape
    optional = [name for name in ("region_ids", "opacities") if getattr(field, name) is not None]
    return " and ".join([f"colors ({', '.join(map(str, [*batch, 'N', channels]))})", *optional])


def _step_colors(state: dict[str, Tensor], group: dict[str, Any], finite: Tensor | None) -> None:
    colors, *opacities = group["params"]
    # the steps of a frozen table go into a copy of it
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
        arrays = _rows(means, cholesky, *gradients)
        loop = partial(loops.step_geometry, *arrays, moves, adam, _bounds(group))
        run_tasks(loop, ranges(len(arrays[0]), _TASK_ROWS), 1 + len(arrays[0]) // _THREAD_ROWS)
        increment_version([parameter for parameter in group["params"] if parameter.requires_grad])
        return
    moving = _moving_rows(state["age"], finite)
    step = _adam(state, local_gradient(cholesky, *gradients), group, moving)
    step = step.clamp(-group["max_step"], group["max_step"])
    bounded = _bounded(*move(means, cholesky, step), group["size"], group["min_sigma"])
    for parameter, values in zip((means, cholesky), bounded, strict=True):
        if parameter.requires_grad:  # a frozen one is not even brought within bounds
            _write(parameter, values, moving)


def _launch(state: dict[Tensor, Any], geometry: dict[str, Any], colors: dict[str, Any]) -> None:
    """Take the step of a field on a CUDA device, geometry and colours at once."""
    from . import cuda  # loads triton

    gradients, adams = [], []
    for group in (geometry, colors):
        moves, averages = _has_gradient(group), state[group["params"][0]].values()
        gradients += [_gradient(p).contiguous() if moves and p.requires_grad else None for p in group["params"]]
        # where nothing moves any address will do: it is not read
        adams.append(Adam(*_settings(group), *(averages if moves else group["params"][:1] * 3)))
    parameters = geometry["params"] + colors["params"]
    cuda.step(parameters, gradients, adams[0], adams[1], _bounds(geometry))
    increment_version([p for p, gradient in zip(parameters, gradients, strict=True) if gradient is not None])


def _bounds(group: dict[str, Any]) -> Bounds:
    """Return the bounds of a step of a field's geometry."""
    limits = group["max_step"], *group["size"], group["min_sigma"], _MIN_FACTOR, _MAX_OUTSIDE
    return Bounds(*map(float, limits))


def _has_gradient(group: dict[str, Any]) -> bool:
    return any(parameter.grad is not None for parameter in group["params"])


def _raises(parameter: Tensor) -> bool:
    """True where gradients that are not finite are an error: reading values of a device would wait for it."""
    return parameter.is_cpu


def _is_compiled(*tensors: Tensor) -> bool:
    """True where compiled loops may read and change the memory of tensors."""
    return not torch.compiler.is_compiling() and all(
        t.dtype is torch.float32 and t.is_cpu and t.is_contiguous() for t in tensors
    )


def _rows(*tensors: Tensor) -> list[Any]:
    """Return arrays (N, K) of tensors (..., N, K), in the same memory where that is contiguous."""
    return [t.detach().contiguous().numpy().reshape(-1, t.shape[-1]) for t in tensors]


def _settings(group: dict[str, Any]) -> list[Any]:
    """Return learning rate, betas and eps as floats; a rate on a device, which a captured graph reads, stays there."""
    rate = group["lr"]
    on_device = isinstance(rate, Tensor) and not _raises(rate)
    return [rate if on_device else float(rate), *map(float, (*group["betas"], group["eps"]))]


def _averages(state: dict[str, Tensor]) -> list[Any]:
    return _rows(state["age"], state["average"], state["square"])


def _check_gradients(gradients: list[Tensor | None]) -> None:
    given = [gradient for gradient in gradients if gradient is not None and _raises(gradient)]
    if given and _is_compiled(*given) and is_within(given, math.inf):
        return
    for gradient in given:
        if not verify(gradient.isfinite().all(), "gradients must be finite"):
            count = int((~gradient.isfinite()).sum())
            cause = "the loss, or an operation between it and the render, is not finite"
            raise InvalidArgument("gradients", "finite", f"{count} NaN or infinite values: {cause}")


def is_within(tables: Sequence[Tensor], limit: float) -> bool:
    """True where the absolute value of every number of tables is below a limit, and none is NaN."""
    if not tables[0].is_cpu:
        return bool(torch.stack([(table.detach().abs() < limit).all() for table in tables]).all())
    # compiled: between renders, whose data fill the caches, an operation of torch takes thirty microseconds
    from . import loops  # loads numba

    return bool(loops.is_within(tuple(table.detach().numpy().ravel() for table in tables), limit))


def _gradient(parameter: Tensor) -> Tensor:
    return torch.zeros_like(parameter) if parameter.grad is None else parameter.grad


def _begin(state: dict[str, Tensor], group: dict[str, Any]) -> None:
    """Make the averages of a group (..., N, K), if there are none; each row has an age of its own."""
    if not state:
        first, *others = group["params"]
        columns = 5 if group["kind"] == "geometry" else first.shape[-1] + len(others)
        for name, width in {"age": 1, "average": columns, "square": columns}.items():
            state[name] = first.new_zeros(*first.shape[:-1], width)


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
    """Return a mask of the Gaussians that move, (..., N, 1): of finite gradients, and not frozen; None: all do."""
    if finite is not None:
        return finite & (age >= 0)
    return age >= 0 if bool((age < 0).any()) else None


def _write(table: Tensor, values: Tensor, moving: Tensor | None) -> None:
    """Put values into a table, (..., N, K); with a mask, in rows that move, where the values are finite."""
    table.copy_(values if moving is None else torch.where(moving & values.isfinite(), values, table))


def _bounded(means: Tensor, cholesky: Tensor, size: tuple[int, int], min_sigma: float) -> tuple[Tensor, Tensor]:
    """Move centres back to about the image, and make Gaussians neither too thin nor larger than the image."""
    height, width = size
    diagonal = math.hypot(height, width)
    l11, l21, l22 = cholesky.unbind(-1)
    l11, l22 = l11.clamp(_MIN_FACTOR, diagonal), l22.clamp(_MIN_FACTOR, diagonal)
    l21 = l21.clamp(-diagonal, diagonal)
    # no tensor of the size: its copy to a device would force a host sync
    reaches, lengths = (_MAX_OUTSIDE * l11, _MAX_OUTSIDE * torch.hypot(l21, l22)), (width, height)
    places = [
        torch.minimum(torch.maximum(place, -reach), reach + length)
        for place, reach, length in zip(means.unbind(-1), reaches, lengths, strict=True)
    ]
    return torch.stack(places, -1), widen(torch.stack([l11, l21, l22], -1), min_sigma)
