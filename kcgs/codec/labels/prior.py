"""What the coder knows about label maps before it has seen one: a small network, trained once, in integers.

docs/format.md has the layout of `prior.bin`; `tests/codec/train_prior.py` trains such a table.
"""

from __future__ import annotations

import math
from importlib import resources
from typing import Any, NamedTuple

import numpy as np

# columns of each row above the pixel that the network sees, nearest row first
_REACH = ((-8, -1), (-8, 7), (-7, 8), (-6, 7), (-5, 6), (-3, 4), (-2, 3))
_OFFSETS = [(dx, -dy) for dy, (low, high) in enumerate(_REACH) for dx in range(low, high + 1)]
TEMPLATE = sorted(_OFFSETS, key=lambda place: (place[0] ** 2 + place[1] ** 2, -place[1], place[0]))
HIDDEN, LATENT = 48, 16
LAYOUT = (
    ("<i1", (len(TEMPLATE), 2, HIDDEN)),
    ("<i2", (HIDDEN,)),
    ("<i1", (HIDDEN, LATENT)),
    ("<i4", (LATENT,)),
    ("<i1", (LATENT, 2)),
    ("<i4", (2,)),
    ("<i4", (4,)),
)


class Prior(NamedTuple):
    """Weights in 1/64, first estimates of the mixer in 1/65536."""

    layer1: Any  # [T, 2, HIDDEN] int32
    bias1: Any  # [HIDDEN] int32
    layer2: Any  # [HIDDEN, LATENT] int32
    bias2: Any  # [LATENT] int32, 1/4096
    layer3: Any  # [LATENT, 2] int32
    bias3: Any  # [2] int32, 1/4096
    mixer: Any  # [4] int32


def load_prior() -> Prior:
    """Read the table that comes with the package."""
    data = resources.files(__package__).joinpath("prior.bin").read_bytes()
    arrays, offset = [], 0
    for kind, shape in LAYOUT:
        count = math.prod(shape)
        arrays.append(np.frombuffer(data, kind, count, offset).reshape(shape).astype(np.int32))
        offset += count * np.dtype(kind).itemsize
    return Prior(*arrays)
