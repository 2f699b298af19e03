"""Prompts for one object: a box and clicks."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from torch import Tensor

from kcgs._check import check_number, check_numbers
from kcgs.errors import InvalidArgument, InvalidArgumentType

Points = Tensor | Sequence[Any]
Point = tuple[float, float]
Box = tuple[float, float, float, float]


class Prompt(NamedTuple):
    """The location of an object, in pixels."""

    box: Box | None
    """Left, top, right, bottom, within the image."""
    foreground: list[Point]
    """Points (x, y) of the object."""
    background: list[Point]
    """Points (x, y) that are not of the object."""

    @property
    def clicks(self) -> list[tuple[Point, int]]:
        """All points, with label 1 for the object and 0 for the background."""
        return [(point, 1) for point in self.foreground] + [(point, 0) for point in self.background]


def check_prompt(image: Tensor, box: Points | None, foreground: Points | None, background: Points | None) -> Prompt:
    """Validate a prompt for an image (3, H, W): the box has pixels of the image, and points lie in the image.

    Points of the object must lie in the box.
    """
    height, width = image.shape[1:]
    corners = None
    if box is not None:
        left, top, right, bottom = check_numbers("box", _to_list(box), 4)
        corners = max(left, 0.0), max(top, 0.0), min(right, float(width)), min(bottom, float(height))
        if not (corners[0] < corners[2] and corners[1] < corners[3]):
            expected = f"left, top, right, bottom with pixels of the {width} x {height} image"
            raise InvalidArgument("box", expected, (left, top, right, bottom), verb="hold")
    prompt = Prompt(
        corners,
        _check_points("foreground", foreground, width, height),
        _check_points("background", background, width, height),
    )
    if corners is not None:
        left, top, right, bottom = corners
        for x, y in prompt.foreground:
            if not (left <= x <= right and top <= y <= bottom):
                raise InvalidArgument("foreground", "in the box", (x, y))
    return prompt


def _check_points(name: str, values: Points | None, width: int, height: int) -> list[Point]:
    points = [] if values is None else _to_list(values)
    if isinstance(points, str) or not all(isinstance(point, Sequence) and len(point) == 2 for point in points):
        raise InvalidArgumentType(name, "a list of points (x, y)", repr(points))
    # a point on the right or lower border of the image counts as in the last pixel
    return [
        (min(check_number(name, x, 0, width), width - 0.5), min(check_number(name, y, 0, height), height - 0.5))
        for x, y in points
    ]


def window_of(box: Box, margin: float, height: int, width: int) -> tuple[slice, slice]:
    """Return the rows and columns of a box that is extended on each side by `margin`, a share of its length."""
    rows, columns = (
        slice(max(0, math.floor(low - margin * (high - low))), min(size, math.ceil(high + margin * (high - low))))
        for low, high, size in ((box[1], box[3], height), (box[0], box[2], width))
    )
    return rows, columns


def _to_list(values: Any) -> Any:
    """Return tensors and arrays, and lists of them, as lists."""
    if hasattr(values, "tolist"):
        return values.tolist()
    return [_to_list(value) for value in values] if isinstance(values, list | tuple) else values
