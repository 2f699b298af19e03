"""What the coder knows about label maps before it has seen one: a small network, trained once, in integers.

docs/format.md has the layout of `prior.bin`; `tests/codec/train_prior.py` trains such a table.
"""

from __future__ import annotations

import math
from importlib import resources
from typing import Any

import numpy as np

# columns of each row above the pixel that the network sees, nearest row first
_REACH = ((-8, -1), (-8, 7), (-7, 8), (-6, 7), (-5, 6), (-3, 4), (-2, 3))
_OFFSETS = [(dx, -dy) for dy, (low, high) in enumerate(_REACH) for dx in range(low, high + 1)]
TEMPLATE = sorted(_OFFSETS, key=lambda place: (place[0] ** 2 + place[1] ** 2, -place[1], place[0]))
HIDDEN, LATENT = 48, 16
# weights are in 1/64, biases of the second and third layer in 1/4096, first estimates of the mixer in 1/65536
LAYOUT = (
    ("<i1", (len(TEMPLATE), 2, HIDDEN)),  # layer1
    ("<i2", (HIDDEN,)),  # bias1
    ("<i1", (HIDDEN, LATENT)),  # layer2
    ("<i4", (LATENT,)),  # bias2
    ("<i1", (LATENT, 2)),  # layer3
    ("<i4", (2,)),  # bias3
    ("<i4", (4,)),  # mixer
)


def load_prior() -> list[Any]:
    """Read the tables that come with the package, as int32, in the order of `LAYOUT`."""
    data = resources.files(__package__).joinpath("prior.bin").read_bytes()
    arrays, offset = [], 0
    for kind, shape in LAYOUT:
        count = math.prod(shape)
        arrays.append(np.frombuffer(data, kind, count, offset).reshape(shape).astype(np.int32))
        offset += count * np.dtype(kind).itemsize
    return arrays
