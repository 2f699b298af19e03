"""A user's own loss, initializer, densifying event and optimizer, in place of the names of a recipe."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

from torch import Tensor

from kcgs.errors import InvalidArgument
from kcgs.maps import RegionMap
from kcgs.nn import GaussianField
from kcgs.optim import FieldOptimizer, Loss

Initializer = Callable[[Tensor, int, RegionMap | None, int], GaussianField]
_OPTIMIZER_MEMBERS = tuple(name for name in vars(FieldOptimizer) if not name.startswith("_"))
# a fit of one image freezes no rows
_BATCH_MEMBERS = ("freeze", "frozen_rows")


@runtime_checkable
class Densifier(Protocol):
    """An event that adds Gaussians to a fit: the argument `densify` of :func:`kcgs.fit`.

    Example:
        >>> import torch
        >>> from kcgs.fitting import fit, propose_gaussians
        >>> class AddOnce:
        ...     end = 0.3
        ...     def act(self, state):
        ...         if state.num_additions == 0 and state.progress >= self.end:
        ...             state.num_additions += 1
        ...             error = state.problem.image - state.render().detach()
        ...             state.optimizer.append(state.field, propose_gaussians(error, 10, state.regions))
        >>> image = torch.linspace(0, 1, 48).expand(3, 32, 48)
        >>> fit(image, num_gaussians=20, iterations=50, densify=AddOnce(), prune=0.0).scene.num_gaussians
        11
    """

    @property
    def end(self) -> float:
        """Share of the fit at the last addition; afterwards contours still move a few times."""

    def act(self, state: Any) -> str | None:
        """Add Gaussians to a :class:`FitState`, if ``state.progress`` says that it is time to.

        The fit calls it before every step. If it returns a string, the fit ends with this reason.
        """


class UserObjects(NamedTuple):
    """Arguments of a fit that a checkpoint cannot store; None where the settings have a name instead."""

    objective: Loss | None = None
    """Function from a render, (1, C, H, W), to a scalar."""
    initializer: Initializer | None = None
    """Function from images, (B, C, H, W), a number of Gaussians, a map or None, and a seed to a batch of fields."""
    densify: Densifier | None = None
    optimizer: Callable[[GaussianField], FieldOptimizer] | None = None


NO_OBJECTS = UserObjects()


def split_names(**arguments: object) -> tuple[dict[str, Any], UserObjects]:
    """Split the arguments of a fit into settings (names) and the user's objects."""
    settings: dict[str, Any] = {name: value for name, value in arguments.items() if isinstance(value, str)}
    objects = UserObjects(**{name: value for name, value in arguments.items() if name not in settings})  # type: ignore[arg-type]
    for name, value in objects._asdict().items():
        if name != "densify" and value is not None and not callable(value):
            raise InvalidArgument(name, "a name or a function", repr(value))
    densify = objects.densify
    if hasattr(densify, "due"):
        raise InvalidArgument("densify", "an event without `due`, whose `act` knows when it acts", repr(densify))
    if densify is not None and not isinstance(densify, Densifier):
        raise InvalidArgument("densify", "an event with `act` and `end`, or None: matching pursuit", repr(densify))
    if objects.objective is not None:  # else the recipe's
        settings["objective"] = None
    return settings, objects


def check_initial(field: object, images: Tensor, num_gaussians: int, regions: RegionMap | None) -> GaussianField:
    """Validate an initializer's field, `num_gaussians` Gaussians for each image; return it without opacities."""
    batch, channels, *size = images.shape
    expected = _layout((batch, num_gaussians, channels), tuple(size), regions is not None)
    received = type(field).__name__
    if isinstance(field, GaussianField):
        received = _layout(tuple(field.colors.shape), field.size, field.region_ids is not None)
        if received == expected:
            return field.without_opacities()
    raise InvalidArgument("initializer", f"a function that returns a GaussianField of {expected}", received)


def _layout(colors: tuple[int, ...], size: tuple[int, ...], has_ids: bool) -> str:
    return f"colors {colors}, size {size} and {'' if has_ids else 'no '}region_ids"


def check_optimizer(optimizer: FieldOptimizer, num_images: int) -> FieldOptimizer:
    """Validate that a user's optimizer has the members of a FieldOptimizer that a fit of so many images calls."""
    names = [name for name in _OPTIMIZER_MEMBERS if num_images > 1 or name not in _BATCH_MEMBERS]
    if missing := [name for name in names if not hasattr(optimizer, name)]:
        expected = f"a function that returns an optimizer with {', '.join(names)}"
        raise InvalidArgument("optimizer", expected, f"{type(optimizer).__name__} without {', '.join(missing)}")
    return optimizer
