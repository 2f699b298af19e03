"""The first weights of the models of Gaussians, measured on photos that no benchmark uses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from kcgs.codec.exact import Floats

_WEIGHT = 0.05  # Gaussians per part of a thousand; larger: the models learn more slowly


class Shapes(NamedTuple):
    """Weights of the bins of each adaptive magnitude, [contexts, bins]."""

    grey: Floats
    hue: Floats
    hue2: Floats
    ratio: Floats


def _shapes(*tables: Sequence[Sequence[float]]) -> Shapes:
    return Shapes(*(_WEIGHT * np.array(table) for table in tables))


# parts of a thousand: grey, hue, hue2 and ratio
# fmt: off
SHAPES = _shapes(
    [
        [5, 4, 3, 5, 7, 11, 24, 58, 115, 132, 129, 118, 106, 92, 76, 56, 33, 17, 9, 5, 3, 2, 1, 1],
    ],
    [
        [29, 30, 30, 31, 34, 40, 54, 79, 106, 110, 111, 85, 66, 69, 52, 37, 22, 13, 5, 3, 2, 2, 1, 1],
        [151, 134, 110, 53, 57, 73, 80, 82, 67, 49, 40, 33, 27, 21, 14, 9, 5, 2, 1, 1, 1, 1, 1, 1],
        [476, 254, 123, 66, 34, 20, 12, 8, 5, 3, 2, 2, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1],
    ],
    [
        [655, 228, 78, 27, 6, 3, 2, 2, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1],
        [498, 262, 104, 54, 33, 18, 12, 9, 6, 3, 2, 2, 2, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1],
        [283, 205, 150, 108, 71, 57, 40, 30, 21, 16, 9, 4, 4, 3, 3, 2, 1, 1, 1, 1, 1, 1, 1, 1],
    ],
    [
        [263, 234, 192, 150, 91, 38, 17, 9, 5, 3, 2, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1],
        [104, 132, 155, 170, 163, 133, 83, 40, 15, 6, 3, 2, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1],
        [91, 105, 117, 123, 124, 127, 119, 92, 60, 29, 12, 4, 2, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1],
        [116, 120, 126, 118, 110, 97, 86, 70, 55, 42, 33, 21, 9, 3, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1],
        [111, 118, 140, 139, 125, 99, 77, 59, 42, 33, 20, 17, 11, 9, 5, 3, 1, 1, 1, 1, 1, 1, 1, 1],
        [101, 109, 143, 147, 142, 104, 85, 56, 44, 24, 17, 12, 8, 4, 4, 4, 4, 1, 1, 1, 1, 1, 1, 1],
        [154, 183, 172, 137, 115, 74, 60, 38, 26, 19, 9, 5, 5, 4, 1, 1, 3, 1, 1, 1, 1, 1, 1, 1],
        [219, 282, 216, 116, 69, 40, 17, 17, 10, 8, 4, 3, 2, 1, 1, 2, 2, 1, 1, 1, 1, 1, 1, 1],
    ],
)
# fmt: on
ANGLE = np.array([4.5, 3.5, 2.7, 2.5, 2.4, 2.5, 2.7, 3.5] * 2)  # weights of the bins of an angle
