"""Files that are damaged at random."""

from __future__ import annotations

import random

from kcgs.codec.file import pack, unpack


def damaged(data: bytes, generator: random.Random, other: bytes = b"") -> bytes:
    """Flip bits, remove, insert, overwrite bytes, cut the end, or put that of another file there."""
    content = bytearray(data)
    kind, start = generator.randrange(5 + bool(other)), generator.randrange(len(content))
    if kind == 0:
        for _ in range(generator.randint(1, 4)):
            content[generator.randrange(len(content))] ^= 1 << generator.randrange(8)
    elif kind == 1:
        del content[start : start + generator.randint(1, 9)]
    elif kind == 2:
        content[start:start] = generator.randbytes(generator.randint(1, 9))
    elif kind == 3:
        content[start : start + 8] = generator.randbytes(8)
    elif kind == 4:
        del content[start:]
    else:
        content[start:] = other[generator.randrange(len(other)) :]
    return bytes(content)


def damaged_inside(data: bytes, generator: random.Random, other: bytes = b"") -> bytes:
    """Damage a scene, with right checksums."""
    header, region_map, layers = unpack(data)
    kind = generator.randrange(4)
    if kind == 0 and region_map:
        region_map = damaged(region_map, generator, other) or b"\0"
    elif kind == 1:
        index = generator.randrange(len(layers))
        layers[index] = damaged(layers[index], generator, other) or b"\0"
    elif kind == 2:
        sizes = [(1, 1), (7, 9), (300, 400), (1 << 16, 1), (1 << 20, 1 << 20)]
        header = header._replace(size=generator.choice(sizes))
    else:
        fields = {"channels": [1, 2, 4, 900], "qp": [-512, 0, 1023], "regions": [1, 2, 4, 70000]}
        name = generator.choice([*fields])
        header = header._replace(**{name: generator.choice(fields[name])})
    entries = zip(header.layers, layers, strict=True)
    return pack(
        header._replace(layers=tuple((energy, len(layer)) for (energy, _), layer in entries)), region_map, layers
    )
