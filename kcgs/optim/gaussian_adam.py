"""Adam in each Gaussian's own frame."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from inspect import unwrap
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import pad
from torch.optim import Optimizer

from kcgs._check import check_number
from kcgs.errors import InvalidArgument, InvalidArgumentType
from kcgs.nn import GaussianField

from .adam import COLOR_RANGE, FROZEN, bounds_of, check_gradients, init_state, state_shapes, step_groups, within_bounds
from .rows import check_added, check_mask, rows_of, select_rows
from .run import cosine_decay

# step of centres, in standard deviations, and of log scales; step of colours: tuned on photos, good on all images
LEARNING_RATE = 0.14
COLOR_LEARNING_RATE = 0.03


class GaussianAdam(Optimizer):
    r"""Adam in each Gaussian's own frame, so that one learning rate suits Gaussians of all sizes and all images.

    Convention: a step moves a centre by :math:`L d` and a factor to :math:`L \exp K`, where d and the lower triangular
    K are Adam's steps; colours move by Adam's steps. Every step leaves a valid field: centres stay within two standard
    deviations of the image, standard deviations between `min_sigma` and the image's diagonal. A field has two parameter
    groups, its geometry and its colours, each with its own ``lr``, which torch's schedulers change.

    Args:
        fields: a GaussianField, or several; fields may be batched.
        lr: step of centres in standard deviations, and of log scales. A tensor on the device of the fields is read at
            each replay of a CUDA graph.
        color_lr: step of colours and opacities.
        betas: decay of the averages of gradients and of squared gradients.
        eps: added to the root of the average of squared gradients, above 0.
        min_sigma: least standard deviation, in pixels. Thinner Gaussians fit the pixels' centres better, but become
            dots and needles when a scene is enlarged.
        max_step: largest step of centres in standard deviations, and of log scales.
        bounded: keep tighter bounds, for fields that a network learns: centres within the image, factors below its
            longer side, colours in [-1, 2].

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

    has_drafts = True
    """True: most of a fit renders with a larger cutoff."""
    keeps_averages = True
    """True: averages stay when Gaussians are added or removed, so that a fit may go on from a finished one."""

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
        bounded: bool = False,
    ) -> None:
        for name, value in {"lr": lr, "color_lr": color_lr, "min_sigma": min_sigma}.items():
            check_number(name, float(value) if isinstance(value, Tensor) else value, 0.0)
        check_number("eps", eps, 0.0, above=True)
        check_number("max_step", max_step, 0.0, above=True)
        if len(betas) != 2 or not all(0 <= beta < 1 for beta in betas):
            raise InvalidArgument("betas", "two numbers in [0, 1)", betas)
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
        settings = {"betas": betas, "eps": eps, "min_sigma": min_sigma, "max_step": max_step, "bounded": bounded}
        super().__init__(groups, settings)

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
        check_gradients([parameter.grad for group in self.param_groups for parameter in group["params"]])
        for geometry, colors in self._pairs():
            step_groups(self.state, geometry, colors)
        return loss

    def rate(self, progress: float) -> float:
        """Return the factor of the learning rates at the share of a fit that is over: a cosine from 1 to 0.1."""
        return cosine_decay(progress)

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """Refuse groups that are no field's: torch calls this when the optimizer is made."""
        if "kind" not in param_group:
            expected = "a GaussianField's: train other parameters with an optimizer of their own"
            raise InvalidArgument("param_group", expected, f"one of {[*param_group]}")
        # unwrapped: torch's decorator, which keeps it out of torch.compile, imports the compiler, which takes 1 to 3 s
        unwrap(Optimizer.add_param_group)(self, param_group)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take the state of a dict; torch calls this in `load_state_dict`."""
        super().__setstate__(state)
        for group in self.param_groups:
            group.setdefault("bounded", False)  # a setting that version 0.3 did not have

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take settings and averages.

        Args:
            state_dict: of an optimizer whose fields have as many Gaussians and channels.

        Raises:
            ValueError: averages of another shape.
        """
        for group, saved in zip(self.param_groups, state_dict["param_groups"], strict=False):  # torch compares lengths
            averages, expected = state_dict["state"].get(saved["params"][0], {}), state_shapes(group)
            received = {name: tuple(table.shape) for name, table in averages.items()}
            if received and received != expected:
                raise InvalidArgument("state_dict", f"of {expected}", received)
        sizes = [geometry["size"] for geometry, _ in self._pairs()]
        super().load_state_dict(state_dict)
        for (geometry, _), size in zip(self._pairs(), sizes, strict=True):
            geometry["size"] = size  # of the field, not of the field that the state is of

    @torch.no_grad()
    def append(self, field: GaussianField, added: GaussianField) -> None:
        """Add Gaussians to one of the optimizer's fields; the averages of the field's present Gaussians stay.

        Args:
            field: a field that the optimizer was made for; it gets new parameters.
            added: a field of the same channels, with region ids and opacities if and only if `field` has them.

        Raises:
            ValueError: a field that the optimizer was not made for, or Gaussians that do not fit to it.
        """
        check_added(field, added)
        geometry, _ = self._groups(field)
        means, cholesky = within_bounds(added.means, added.cholesky, bounds_of(geometry))
        colors = added.colors.clamp(*COLOR_RANGE) if geometry["bounded"] else added.colors
        parts = {"means": means, "cholesky": cholesky, "colors": colors, "opacities": added.opacities}
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
            field: a field that the optimizer was made for; it gets new parameters.
            mask: boolean :math:`(N)`, for all images of a batch; or :math:`(B, N)`, with equal counts in all images.

        Raises:
            ValueError: a field that the optimizer was not made for; a mask of another type or shape, or of more
                Gaussians in one image than in another.
        """
        self._groups(field)
        index, rows = rows_of(field, mask), field.means.ndim - 2
        for name in ("means", "cholesky", "colors", "opacities"):
            if (value := getattr(field, name)) is not None:
                self._replace(field, name, select_rows(value, index, rows))
        if field.region_ids is not None:
            field.region_ids = select_rows(field.region_ids, index, rows)
        for state in self._states(field):
            state.update({name: select_rows(average, index, rows) for name, average in state.items()})

    @torch.no_grad()
    def freeze(self, field: GaussianField, mask: Tensor) -> None:
        """Leave Gaussians as they are from here on, whatever their gradients.

        Args:
            field: a field that the optimizer was made for.
            mask: of the Gaussians to freeze, boolean, :math:`(N)` or :math:`(B, N)` as the field.

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
        groups = self._groups(field)
        check_mask(mask, field.means.shape[:-1])
        for group in groups:
            state = self.state[group["params"][0]]
            init_state(state, group)
            state["age"].masked_fill_(mask[..., None], FROZEN)

    def frozen_rows(self, field: GaussianField) -> Tensor:
        """Return the mask of the Gaussians that `freeze` has frozen, boolean, :math:`(N)` or :math:`(B, N)`."""
        age = self.state[field.means].get("age")
        return torch.zeros_like(field.means[..., 0], dtype=torch.bool) if age is None else age[..., 0] < 0

    def _pairs(self) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
        """Return the groups of each field: its geometry and its colours."""
        return zip(self.param_groups[::2], self.param_groups[1::2], strict=True)

    def _groups(self, field: GaussianField) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return the groups of a field; ValueError for a field that the optimizer was not made for."""
        for geometry, colors in self._pairs():
            if geometry["params"][0] is field.means:
                return geometry, colors
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
