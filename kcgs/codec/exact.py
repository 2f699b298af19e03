"""Functions of real numbers that give the same bits on every machine.

Libraries of elementary functions differ in the last bit. These use only sums, products, and powers of two of float64,
each of which IEEE 754 rounds in one way, and numpy never fuses them.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

_LN2 = 0.6931471805599453
_EXP = [1.0 / math.factorial(i) for i in range(15)]
_SIN = [(-1.0) ** i / math.factorial(2 * i + 1) for i in range(13)]
_COS = [(-1.0) ** i / math.factorial(2 * i) for i in range(13)]


def exp2(x: Floats) -> Floats:
    """Return 2**x to within a few units of the last place, |x| at most 1,000."""
    whole = np.floor(x + 0.5)
    return np.ldexp(_polynomial(_EXP, (x - whole) * _LN2), whole.astype(np.int32))


def turn(share: Floats) -> tuple[Floats, Floats]:
    """Return the cosine and sine of pi times `share`, which is in [0, 1]."""
    angle = (share - 0.5) * math.pi
    square = angle * angle
    return -angle * _polynomial(_SIN, square), _polynomial(_COS, square)


def _polynomial(coefficients: list[float], x: Floats) -> Floats:
    total = np.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        total *= x
        total += coefficient
    return total
