"""What the coder knows about label maps before it has seen one: a small network, trained once, in integers.

`prior.bin` holds these arrays one after the other, the last index running fastest, lowest bytes first: ``layer1``, int8
[T, 2, 48], T being the length of the template; ``bias1``, int16 [48]; ``layer2``, int8 [48, 16]; ``bias2``, int32 [16];
``layer3``, int8 [16, 2]; ``bias3``, int32 [2]; ``mixer``, int32 [4]. `contexts` says what they are for. The network was
trained on segmentations of Kodak photos and of scikit-image's, and on drawn shapes: none of DAVIS or BSDS.
"""

from __future__ import annotations

import math
from importlib import resources
from typing import Any, NamedTuple

import numpy as np

# columns of each row above the pixel that the network sees, nearest row first
_REACH = ((-8, -1), (-8, 7), (-7, 8), (-6, 7), (-5, 6), (-3, 4), (-2, 3))
_OFFSETS = [(dx, -dy) for dy, (low, high) in enumerate(_REACH) for dx in range(low, high + 1)]
TEMPLATE = sorted(_OFFSETS, key=lambda at: (at[0] ** 2 + at[1] ** 2, -at[1], at[0]))
HIDDEN, LATENT = 48, 16
_LAYOUT = (
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
    return unpack(data)


def unpack(data: bytes) -> Prior:
    """Take the file apart."""
    arrays, at = [], 0
    for kind, shape in _LAYOUT:
        count = math.prod(shape)
        arrays.append(np.frombuffer(data, kind, count, at).reshape(shape).astype(np.int32))
        at += count * np.dtype(kind).itemsize
    return Prior(*arrays)
