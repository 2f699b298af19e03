"""What users pass in place of the names of a recipe: a loss, an event that adds Gaussians, an optimizer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

from kcgs.errors import InvalidArgument
from kcgs.nn import GaussianField
from kcgs.optim import Event, Loss


@runtime_checkable
class Densifier(Event, Protocol):
    """An event that adds Gaussians to a fit."""

    @property
    def end(self) -> float:
        """Share of the fit at its last addition; after it contours move a few times on their own."""


class Custom(NamedTuple):
    """Arguments of a fit that no file keeps; None where the settings have a name."""

    objective: Loss | None = None
    """From a render, (1, C, H, W), to a scalar."""
    densify: Densifier | None = None
    optimizer: Callable[[GaussianField], Any] | None = None
    """Returns an optimizer with the methods of GaussianAdam."""


NONE = Custom()


def split_names(**arguments: object) -> tuple[dict[str, Any], Custom]:
    """Split the arguments objective, densify and optimizer into settings, by name, and objects of the user's."""
    settings: dict[str, Any] = {name: value for name, value in arguments.items() if isinstance(value, str)}
    custom = Custom(**{name: value for name, value in arguments.items() if name not in settings})  # type: ignore[arg-type]
    for name, value in custom._asdict().items():
        if name != "densify" and value is not None and not callable(value):
            raise InvalidArgument(name, "a name or a function", repr(value))
    densify = custom.densify
    if hasattr(densify, "due"):
        raise InvalidArgument("densify", "an event without `due`, whose `act` knows when it acts", repr(densify))
    if densify is not None and not isinstance(densify, Densifier):
        raise InvalidArgument("densify", "a name, or an event with `act` and `end`", repr(densify))
    if custom.objective is not None:  # else the recipe's
        settings["objective"] = None
    return settings, custom
