"""A box and clicks that ask for one object."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from kcgs._check import check_number, check_numbers
from kcgs.errors import InvalidArgument, InvalidArgumentType

Points = Tensor | Sequence[Any]


class Prompt(NamedTuple):
    """What says where an object is, in pixels."""

    box: tuple[float, float, float, float] | None
    """Left, top, right, bottom, within the image."""
    foreground: list[tuple[float, float]]
    """Points (x, y) of the object."""
    background: list[tuple[float, float]]
    """Points (x, y) that are not of the object."""


def check_prompt(image: Tensor, box: Points | None, foreground: Points | None, background: Points | None) -> Prompt:
    """Return the prompt if its points lie in the image, (3, H, W), and its box has pixels of it."""
    height, width = image.shape[1:]
    corners = None
    if box is not None:
        left, top, right, bottom = check_numbers("box", _to_list(box), 4)
        corners = max(left, 0.0), max(top, 0.0), min(right, float(width)), min(bottom, float(height))
        if not (corners[0] < corners[2] and corners[1] < corners[3]):
            expected = f"left, top, right, bottom with pixels of the {width} x {height} image"
            raise InvalidArgument("box", expected, (left, top, right, bottom), verb="hold")
    points = (_check_points(name, values, width, height) for name, values in (
        ("foreground", foreground), ("background", background),
    ))  # fmt: skip
    return Prompt(corners, *points)


def _check_points(name: str, values: Points | None, width: int, height: int) -> list[tuple[float, float]]:
    points = [] if values is None else _to_list(values)
    if isinstance(points, str) or not all(isinstance(point, Sequence) and len(point) == 2 for point in points):
        raise InvalidArgumentType(name, "a list of points (x, y)", repr(points))
    # the right border of the image is that of its last pixel
    return [
        (min(check_number(name, x, 0, width), width - 0.5), min(check_number(name, y, 0, height), height - 0.5))
        for x, y in points
    ]


def _to_list(values: Points) -> Any:
    return torch.as_tensor(values).tolist() if hasattr(values, "tolist") else values
