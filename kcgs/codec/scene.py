"""Fields and their maps as `.kcgs` bytes, and back."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcgs._check import check_floating
from kcgs.functional import RegionMap
from kcgs.functional.covariance import check_cholesky
from kcgs.nn import GaussianField
from kcgs.scene import Scene

from .errors import CodecError
from .gaussians import Layers, Lookup, layer_order, pick
from .maps import MOST_SUPERSAMPLE, decode_map, encode_map
from .quantize import NOISE_CODES, Classes, Codes, Quantizer
from .rangecoder import Reader, Writer
from .stream import (
    MOST_CHANNELS,
    MOST_COLORS,
    MOST_GAUSSIANS,
    MOST_LABELS,
    MOST_REGIONS,
    MOST_SIDE,
    SPARE,
    Header,
    most_gaussians,
    pack,
    unpack,
)

Integers = NDArray[np.int64]

# of the picture that is decoded against the scene's own, in dB
QUALITIES = (10.0, 90.0)
DEFAULT_QUALITY = 46.0


class Decoded(NamedTuple):
    """What a file holds."""

    field: GaussianField
    regions: RegionMap | None  # None: one region
    layers: int
    """How many layers were there."""
    num_layers: int
    """How many there are in the whole file."""


def encode(
    field: GaussianField,
    regions: RegionMap | Tensor | None = None,
    *,
    quality: float | None = None,
    target_bytes: int | None = None,
) -> bytes:
    """Write a scene as a `.kcgs` file; the same scene gives the same bytes.

    Convention: the picture is not looked at. Every parameter is rounded so that it adds the same squared error to the
    picture; where centres are far outside the image, they are brought nearer. Gaussians whose colour rounds to black
    are left out. :func:`kcgs.fit.fine_tune` makes up for most of the error where the image is at hand.

    Args:
        field: N Gaussians of one image; opacities are merged into the colours.
        regions: the map to draw with (a Tensor means hard contours), kept without loss; None, or a map of one region:
            one region, which takes one byte.
        quality: PSNR in dB of the decoded picture against the scene's own, before clipping, 10 to 90; 46 by default.
        target_bytes: the finest file that is not larger, in place of `quality`.

    Returns:
        The file.

    Raises:
        TypeError: an argument of the wrong type.
        ValueError: a batch, no Gaussians, values that are not finite, region ids that the map does not hold, both
            `quality` and `target_bytes`, numbers out of range, more than a file may hold (:mod:`kcgs.codec.stream`),
            a target that the coarsest file misses.

    Example:
        >>> field = GaussianField.random(100, (32, 48), seed=0)
        >>> data = encode(field, quality=40)
        >>> len(data) < 1000, decode(data).field.size
        (True, (32, 48))
    """
    regions, ids = check_scene(field, regions)
    if quality is not None and target_bytes is not None:
        raise ValueError(f"quality and target_bytes exclude each other; got {quality!r} and {target_bytes!r}")
    region_map = None if regions is None else encode_map(regions)
    if target_bytes is None:
        code = noise_code_for(DEFAULT_QUALITY if quality is None else quality, field)
        return _encode_at(field, regions, ids, code, region_map)
    return finest(lambda code: _encode_at(field, regions, ids, code, region_map), target_bytes, field)[1]


def decode(data: bytes, *, max_bytes: int | None = None) -> Decoded:
    """Read a `.kcgs` file, or the picture that its first bytes hold.

    Args:
        data: the file; one that ends early gives a coarser picture, as long as its first layer is whole.
        max_bytes: read no more than these.

    Returns:
        Field (float32, on the CPU, bit for bit the same on every machine), regions, and how much of the file that is.

    Raises:
        TypeError: an argument of the wrong type.
        CodecError: a ValueError; the file is damaged, or none, or too short to hold a picture.

    Example:
        >>> data = encode(GaussianField.random(200, (32, 48), seed=0))
        >>> whole, part = decode(data), decode(data, max_bytes=len(data) // 2)
        >>> whole.layers == whole.num_layers, part.layers < part.num_layers, len(part.field) < len(whole.field)
        (True, True, True)
    """
    if not isinstance(data, bytes | bytearray | memoryview):
        raise TypeError(f"data must be bytes; got {type(data).__name__}")
    if max_bytes is not None and (isinstance(max_bytes, bool) or not isinstance(max_bytes, int)):
        raise TypeError(f"max_bytes must be an integer; got {max_bytes!r}")
    if max_bytes is not None and max_bytes < 1:
        raise ValueError(f"max_bytes must be at least 1; got {max_bytes}")
    header, region_map, layers = unpack(bytes(data[:max_bytes]))
    regions = None if header.regions == 1 else decode_map(region_map, header.size, header.regions)
    quantizer = Quantizer(header.noise_code, header.size)
    model = Layers(quantizer, header.channels, header.regions, _lookup(regions))
    parts, ids, count = [], [], 0
    for (energy, _), layer in zip(header.layers, layers, strict=False):
        most = most_gaussians(len(layer), header.channels, count)
        restored, own = model.code(Reader(layer), energy, None, None, most)
        parts.append(restored)
        ids.append(own)
        count += len(own)
    means, cholesky, colors = (torch.from_numpy(np.concatenate(t)) for t in zip(*parts, strict=True))
    region_ids = None if regions is None else regions.ids[torch.from_numpy(np.concatenate(ids))]
    try:
        field = GaussianField(means, cholesky, colors, region_ids, size=header.size)
    except ValueError as error:
        raise CodecError(f"the file holds no Gaussians that can be drawn: {error}") from error
    return Decoded(field, regions, len(layers), len(header.layers))


def serialize(scene: Scene) -> bytes:
    """Write a scene as `encode` does by default, for `kcgs.save`."""
    return encode(scene.field, scene.regions)


def deserialize(data: bytes) -> Scene:
    """Read a whole file, for `kcgs.load`."""
    decoded = decode(data)
    if decoded.layers < decoded.num_layers:
        raise CodecError(
            f"it ends early, with {decoded.layers} of {decoded.num_layers} layers; kcgs decode renders what is there"
        )
    return Scene(decoded.field, decoded.regions)


def encode_codes(
    quantizer: Quantizer, codes: Codes, ids: Integers, regions: RegionMap | None, region_map: bytes | None = None
) -> bytes:
    """Write Gaussians that are whole numbers already, with `ids` as positions among the map's."""
    order = layer_order(codes)
    codes, ids = pick(codes, order), ids[order]
    count, channels = codes.colors.shape
    model = Layers(quantizer, channels, 1 if regions is None else regions.num_regions, _lookup(regions))
    energies, starts = np.unique(-codes.classes.energy, return_index=True)
    ends, layers = [*starts[1:].tolist(), count], []
    for energy, start, end in zip((-energies).tolist(), starts.tolist(), ends, strict=True):
        writer = Writer()
        model.code(writer, energy, pick(codes, slice(start, end)), ids[start:end], count)
        # each Gaussian takes more than a bit, but zeros at the end are left out
        layers.append(writer.finish().ljust(-(-(end - start - SPARE) // 8), b"\0"))
    header = Header(
        quantizer.size,
        channels,
        quantizer.noise_code,
        1 if regions is None else regions.num_regions,
        tuple((int(-energy), len(layer)) for energy, layer in zip(energies, layers, strict=True)),
    )
    if region_map is None:
        region_map = b"" if regions is None else encode_map(regions)
    return pack(header, region_map, layers)


def check_scene(field: GaussianField, regions: RegionMap | Tensor | None) -> tuple[RegionMap | None, Integers]:
    """Return the regions, None where there is one, and each Gaussian's, as positions among the map's ids."""
    if not isinstance(field, GaussianField):
        raise TypeError(f"field must be a GaussianField; got {type(field).__name__}")
    if field.means.ndim != 2 or len(field) == 0:
        raise ValueError(f"field must hold the Gaussians of one image; got means of shape {tuple(field.means.shape)}")
    _check_field(field)
    if isinstance(regions, Tensor):
        regions = RegionMap.from_labels(regions)
    if regions is not None and not isinstance(regions, RegionMap):
        raise TypeError(f"regions must be a RegionMap, a label map or None; got {type(regions).__name__}")
    if regions is None or regions.num_regions == 1:
        return None, np.zeros(len(field), np.int64)
    if regions.labels.ndim != 2 or regions.size != field.size:
        raise ValueError(f"regions must be one map of size {field.size}; got {tuple(regions.labels.shape)}")
    _check_map(regions)
    if field.region_ids is None:
        raise ValueError("field must have region_ids where regions are given; call field.assign_regions(regions)")
    index = regions.index_of(field.region_ids.to(regions.ids.device))
    if (index < 0).any():
        unknown = int(field.region_ids[index.to(field.region_ids.device) < 0][0])
        raise ValueError(f"region_ids must be ids of the map; got {unknown}")
    return regions.to("cpu"), index.cpu().numpy()


def _check_field(field: GaussianField) -> None:
    """Refuse what no file can hold; a parameter may have been changed since the field was made."""
    check_floating("means", field.means.detach().float())
    check_cholesky("cholesky", field.cholesky.detach().float())
    check_floating("colors", field.merged_colors().detach().float())
    channels = field.colors.shape[-1]
    if max(field.size) > MOST_SIDE:
        raise ValueError(f"size must be at most {MOST_SIDE} pixels a side; got {field.size}")
    if channels > MOST_CHANNELS:
        raise ValueError(f"colors must have at most {MOST_CHANNELS} channels; got {channels}")
    most = min(MOST_GAUSSIANS, MOST_COLORS // channels)
    if len(field) > most:
        raise ValueError(f"field must hold at most {most} Gaussians of {channels} channels; got {len(field)}")


def _check_map(regions: RegionMap) -> None:
    labels = regions.fine_labels
    if labels.numel() > MOST_LABELS:
        raise ValueError(f"regions must have at most {MOST_LABELS} labels; got {tuple(labels.shape)}")
    if regions.supersample > MOST_SUPERSAMPLE:
        raise ValueError(f"supersample must be at most {MOST_SUPERSAMPLE}; got {regions.supersample}")
    if regions.num_regions > MOST_REGIONS:
        raise ValueError(f"regions must be at most {MOST_REGIONS}; got {regions.num_regions}")


def noise_code_for(quality: float, field: GaussianField) -> int:
    """Return the code of the noise at which rounding costs this PSNR, in dB, against the unrounded scene."""
    if isinstance(quality, bool) or not isinstance(quality, int | float):
        raise TypeError(f"quality must be a number of dB; got {quality!r}")
    if not QUALITIES[0] <= quality <= QUALITIES[1]:
        raise ValueError(f"quality must be in [{QUALITIES[0]:g}, {QUALITIES[1]:g}] dB; got {quality!r}")
    channels = field.colors.shape[-1]
    samples = channels * field.size[0] * field.size[1]
    noise = samples * 10 ** (-quality / 10) / (len(field) * (5 + channels))
    return code_for_noise(noise)


def code_for_noise(noise: float) -> int:
    """Return the code whose noise is nearest to D = `noise`, squared error that a parameter adds."""
    return min(max(math.floor(-32 * math.log2(max(noise, 1e-12)) + 0.5), NOISE_CODES[0]), NOISE_CODES[1])


def finest(
    encode_at: Callable[[int], bytes], target_bytes: int, field: GaussianField, *, share: float = 1.0
) -> tuple[int, bytes]:
    """Return the noise code with the largest file of at most this share of `target_bytes`, and that file.

    A step of the code is 1/32 of a bit for each number of a Gaussian, so that a few files tell which.
    """
    if isinstance(target_bytes, bool) or not isinstance(target_bytes, int):
        raise TypeError(f"target_bytes must be an integer; got {target_bytes!r}")
    most = round(share * target_bytes)
    low, high = NOISE_CODES[0], noise_code_for(QUALITIES[1], field)
    code, best = min(max(noise_code_for(DEFAULT_QUALITY, field), low), high), None
    slope = len(field) * (5 + field.colors.shape[-1]) / (8 * 32)
    while low <= high:
        data = encode_at(code)
        if len(data) <= most:
            best, low = (code, data), code + 1
        else:
            least, high = len(data), code - 1
        code = min(max(code + math.floor((most - len(data)) / slope), low), high)
    if best is None:
        raise ValueError(f"target_bytes must be at least {math.ceil(least / share)} for this scene; got {target_bytes}")
    return best


def numbers(field: GaussianField) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return means, cholesky and colours with opacities merged, as float64 arrays."""
    tensors = field.means, field.cholesky, field.merged_colors()
    means, cholesky, colors = (t.detach().cpu().double().numpy() for t in tensors)
    return means, cholesky, colors


def _encode_at(
    field: GaussianField, regions: RegionMap | None, ids: Integers, code: int, region_map: bytes | None
) -> bytes:
    quantizer = Quantizer(code, field.size)
    means, cholesky, colors = numbers(field)
    classes = quantizer.classify(cholesky, colors)
    seen = quantizer.is_seen(colors, classes)
    if not seen.any():
        seen[0] = True
    kept = Classes(classes.energy[seen], classes.size[seen])
    codes = quantizer.quantize(means[seen], cholesky[seen], colors[seen], kept)
    return encode_codes(quantizer, codes, ids[seen], regions, region_map)


def _lookup(regions: RegionMap | None) -> Lookup | None:
    if regions is None:
        return None

    labels = regions.labels.numpy()
    height, width = regions.size

    def under(means: NDArray[np.float32]) -> Integers:
        column, row = np.floor(means).T
        at = np.clip(row, 0, height - 1).astype(np.int64), np.clip(column, 0, width - 1).astype(np.int64)
        found: Integers = regions.index_of(torch.from_numpy(labels[at])).numpy()
        return found.astype(np.int64)

    return under
