"""The names of objectives, and which names each purpose takes; without torch, since the command line reads them."""

from __future__ import annotations

from typing import Literal, get_args

from ._names_0_3 import OBJECTIVES, describe
from .errors import InvalidArgument

ObjectiveName = Literal["l2", "l1", "ms-ssim"]
Purpose = Literal["fit", "file of a size", "file of a PSNR", "video"]
NAMES: tuple[ObjectiveName, ...] = get_args(ObjectiveName)
# the objectives of each purpose; the first is its default
PURPOSES: dict[Purpose, tuple[ObjectiveName, ...]] = {
    "fit": NAMES,
    "file of a size": ("ms-ssim", "l2"),
    "file of a PSNR": ("l2", "ms-ssim"),
    "video": ("l2", "ms-ssim"),
}


def check_objective(name: object) -> ObjectiveName | None:
    """Return the name of an objective, or None."""
    if name is None or name in NAMES:
        return name
    received = describe(name, OBJECTIVES)
    if not isinstance(name, str):
        received = "a function, which only kcgs.fit takes" if callable(name) else type(name).__name__
    raise InvalidArgument("objective", f"one of {', '.join(NAMES)}", received)


def objective_for(purpose: Purpose, name: ObjectiveName | None) -> ObjectiveName:
    """Return the objective `name` for a purpose, its default for None; refuse an objective that it does not take."""
    names = PURPOSES[purpose]
    if name is not None and name not in names:
        raise InvalidArgument("objective", f"{' or '.join(names)} for a {purpose}", repr(name))
    return name or names[0]
