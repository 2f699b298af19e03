"""Functions of real numbers that give the same bits on every machine.

Libraries of elementary functions differ in the last bit. These use only sums, products and powers of two of float64,
which IEEE 754 rounds in one way and numpy never fuses.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

LN2 = 0.6931471805599453
# coefficients of Taylor polynomials, the lowest first: e^x; sin(x) / x and cos(x) in x^2
_EXP = [1.0 / math.factorial(i) for i in range(15)]
_SIN = [(-1.0) ** i / math.factorial(2 * i + 1) for i in range(13)]
_COS = [(-1.0) ** i / math.factorial(2 * i) for i in range(13)]


def exp2(x: Floats) -> Floats:
    """Return 2**x to a few units in the last place, for |x| of at most 1,000."""
    whole = np.floor(x + 0.5)
    return np.ldexp(_polynomial(_EXP, (x - whole) * LN2), whole.astype(np.int32))


def cos_sin(share: Floats) -> tuple[Floats, Floats]:
    """Return cosine and sine of an angle; 0 to 1 is half a turn."""
    angle = (share - 0.5) * math.pi
    square = angle * angle
    return -angle * _polynomial(_SIN, square), _polynomial(_COS, square)


def _polynomial(coefficients: list[float], x: Floats) -> Floats:
    """Evaluate a polynomial by Horner's rule."""
    total = np.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        total *= x
        total += coefficient
    return total
