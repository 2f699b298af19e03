"""`.kcgs` bytes as scenes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from kcgs._check import check_count
from kcgs.nn import GaussianField
from kcgs.scene import Scene

from .file import SPARE, most_gaussians, unpack
from .gaussians.layers import LayerCoder
from .gaussians.quantize import Quantizer
from .rangecoder import CodecError, Reader


class Decoded(NamedTuple):
    """The scene of a file (without regions where there is one), the layers that were there, and those of all of it."""

    scene: Scene
    layers: int
    num_layers: int


def decode(data: bytes, *, max_bytes: int | None = None) -> Decoded:
    """Read a `.kcgs` file, or the coarser scene that its first bytes hold.

    Args:
        data: the file; one that ends early gives a coarser scene, as long as its first layer is whole.
        max_bytes: read no more than these.

    Returns:
        The scene (float32, on the CPU, bit for bit the same on every machine), and how much of the file that is.

    Raises:
        TypeError: an argument of the wrong type.
        CodecError: a ValueError; the file is damaged, or none, or too short to hold an image.

    Example:
        >>> from kcgs.codec import encode
        >>> data = encode(Scene(GaussianField.random(200, (32, 48), seed=0)))
        >>> whole, part = decode(data), decode(data, max_bytes=len(data) // 2)
        >>> whole.layers == whole.num_layers, part.layers < part.num_layers, len(part.scene) < len(whole.scene)
        (True, True, True)
    """
    if not isinstance(data, bytes | bytearray | memoryview):
        raise TypeError(f"data must be bytes; got {type(data).__name__}")
    if max_bytes is not None:
        max_bytes = check_count("max_bytes", max_bytes)
    header, region_map, layers = unpack(bytes(data[:max_bytes]))
    regions = None
    if header.regions > 1:
        from .labels import decode_map  # loads numba

        regions = decode_map(region_map, header.size, header.regions)
    model = LayerCoder(Quantizer(header.qp, header.size), header.channels, regions)
    parts, ids, left = [], [], most_gaussians(header.channels)
    for (energy, _), layer in zip(header.layers, layers, strict=False):
        # each Gaussian takes more than a bit, and all must fit into memory
        gaussians, positions = model.code(Reader(layer), energy, None, None, min(8 * len(layer) + SPARE, left))
        parts.append(gaussians)
        ids.append(positions)
        left -= len(positions)
    means, cholesky, colors = (torch.from_numpy(np.concatenate(numbers)) for numbers in zip(*parts, strict=True))
    region_ids = None if regions is None else regions.ids[torch.from_numpy(np.concatenate(ids))]
    try:
        field = GaussianField(means, cholesky, colors, region_ids, size=header.size)
    except ValueError as error:
        raise CodecError(f"the file holds no Gaussians that can be rendered: {error}") from error
    return Decoded(Scene(field, regions), len(layers), len(header.layers))


def deserialize(data: bytes) -> Scene:
    """Read a whole file, for :func:`kcgs.load`."""
    decoded = decode(data)
    if decoded.layers < decoded.num_layers:
        raise CodecError(
            f"it ends early, with {decoded.layers} of {decoded.num_layers} layers; kcgs decode renders what is there"
        )
    return decoded.scene
