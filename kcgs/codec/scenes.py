"""Write scenes as `.kcgs` files, and read them."""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch

from kcgs._check import check_count, check_floating, check_number
from kcgs._repr import brief
from kcgs.errors import InvalidArgument, InvalidArgumentType
from kcgs.functional import check_cholesky
from kcgs.maps import RegionMap
from kcgs.nn import GaussianField
from kcgs.scene import Scene, check_scene

from .exact import Integers
from .file import MAX_CHANNELS, MAX_SIDE, Header, max_gaussians, pack, unpack
from .gaussians.layers import LayerCoder
from .gaussians.quantize import QP_PER_OCTAVE, QPS, Classes, Codes, Parameters, Quantizer
from .rangecoder import Reader, Writer
from .region_map import decode_region_map, encode_region_map

# PSNR in dB of the decoded render against the scene's own
QUALITIES = (10.0, 90.0)  # least and largest
DEFAULT_QUALITY = 46.0
_MIN_DISTORTION = 1e-12  # least squared error that a number adds
# least Gaussians of a layer: its length and checksum take about 6 bytes, and a few hundred bytes arrive at once
_MIN_SHARE = 1 / 16  # as a share of the Gaussians of a file
_MIN_GAUSSIANS = 100
_FREE_GAUSSIANS = 64  # a layer has at least a bit for each Gaussian beyond these


def encode(scene: Scene, *, quality: float | None = None, target_bytes: int | None = None) -> bytes:
    """Write a scene as a `.kcgs` file; the same scene gives the same bytes.

    Convention: every parameter is rounded so that it adds the same squared error to the render; the fitted image is not
    used. Centres far outside the image are moved nearer. Gaussians whose colour rounds to black are left out. The
    labels of the map are lossless; its softness is rounded to fortieths of a pixel. If you have the image,
    :func:`kcgs.rate.compress` corrects most of the error.

    Args:
        scene: N Gaussians of one image. Opacities are merged into the colours; metadata and a map of one region are
            not stored.
        quality: PSNR in dB of the decoded render against the scene's own render, before clipping, 10 to 90; 46 by
            default.
        target_bytes: write the largest file of at most this size, in place of `quality`.

    Returns:
        The file.

    Raises:
        TypeError: an argument of the wrong type.
        ValueError: a batch, values that are not finite, region ids that the map does not hold, both
            `quality` and `target_bytes`, numbers out of range, more than a file may hold (:mod:`kcgs.codec.file`),
            a target below the smallest file.

    Example:
        >>> from kcgs import GaussianField
        >>> from kcgs.codec import decode
        >>> data = encode(Scene(GaussianField.random(100, (32, 48), seed=0)), quality=40)
        >>> len(data) < 1000, decode(data).scene.size
        (True, (32, 48))
    """
    writer = SceneWriter(scene)
    qp = writer.qp_for(quality, target_bytes)
    if target_bytes is None:
        return writer.write_rounded(qp)
    return writer.largest_file(writer.write_rounded, target_bytes)[1]


class SceneWriter:
    """Write files of a scene at any quantization parameter; its map is coded only once."""

    def __init__(self, scene: Scene) -> None:
        field, regions = check_scene(scene).field, scene.regions
        if not field.num_gaussians:
            field = _black_field(field, regions)
        _check_field(field)
        self.size, self.channels = field.size, field.colors.shape[-1]
        tensors = field.means, field.cholesky, field.merged_colors()
        self.gaussians = Parameters(*(t.detach().cpu().double().numpy() for t in tensors))
        self.regions = None if regions is None or regions.num_regions == 1 else regions.to("cpu")
        self.ids = np.zeros(field.num_gaussians, np.int64)  # indices into the map's ids
        self.region_map = b""
        if self.regions is not None:
            assert field.region_ids is not None
            ids = field.region_ids.cpu()
            self.ids = self.regions.index_of(ids).numpy()
            if (self.ids < 0).any():
                raise InvalidArgument("region_ids", "ids of the map", int(ids[self.ids < 0][0]))
            self.region_map = encode_region_map(self.regions)

    def qp_for(self, quality: float | None, target_bytes: int | None = None) -> int:
        """Return the quantization parameter at which rounding alone gives `quality`, a PSNR in dB."""
        if quality is not None and target_bytes is not None:
            raise InvalidArgument("quality", "None with target_bytes", quality)
        decibels = check_number("quality", DEFAULT_QUALITY if quality is None else quality, *QUALITIES, unit="dB")
        samples = self.channels * self.size[0] * self.size[1]
        distortion = samples * 10 ** (-decibels / 10) / self._count_numbers()
        octaves = math.log2(max(distortion, _MIN_DISTORTION))
        return min(max(math.floor(-QP_PER_OCTAVE * octaves + 0.5), QPS[0]), QPS[1])

    def largest_file(self, write: Callable[[int], bytes], target_bytes: int) -> tuple[int, bytes]:
        """Search for the largest file of at most `target_bytes`; return its quantization parameter and the file."""
        max_bytes = check_count("target_bytes", target_bytes)
        low, high = QPS[0], self.qp_for(QUALITIES[1])
        qp, best = min(max(self.qp_for(DEFAULT_QUALITY), low), high), None
        while low <= high:
            data = write(qp)
            if len(data) <= max_bytes:
                best, low = (qp, data), qp + 1
            else:
                smallest, high = len(data), qp - 1
            qp = min(max(self.next_qp(qp, len(data), max_bytes), low), high)
        if best is None:
            raise InvalidArgument("target_bytes", f"at least {smallest} for this scene", target_bytes)
        return best

    def next_qp(self, qp: int, num_bytes: int, target_bytes: int) -> int:
        """Return the quantization parameter for `target_bytes`, if the file at `qp` has `num_bytes`.

        An octave of the distortion is about one bit per number.
        """
        bits = (target_bytes - num_bytes) * 8
        return min(max(qp + math.floor(bits * QP_PER_OCTAVE / self._count_numbers()), QPS[0]), QPS[1])

    def _count_numbers(self) -> int:
        return len(self.ids) * (5 + self.channels)

    def with_gaussians(self, gaussians: Parameters, ids: Integers) -> SceneWriter:
        """Return a writer of other Gaussians with the same map."""
        other = copy.copy(self)
        other.gaussians, other.ids = gaussians, ids
        return other

    def write_rounded(self, qp: int) -> bytes:
        """Write the file with each Gaussian rounded on its own."""
        quantizer = Quantizer(qp, self.size)
        classes = quantizer.classify(self.gaussians)
        is_visible = quantizer.steps(classes).round_colors(self.gaussians.colors).any(1)
        index = np.flatnonzero(is_visible) if is_visible.any() else np.zeros(1, np.int64)
        gaussians = Parameters(*(numbers[index] for numbers in self.gaussians))
        codes = quantizer.quantize(gaussians, Classes(*(numbers[index] for numbers in classes)))
        return self.write(quantizer, codes, self.ids[index])

    def write(self, quantizer: Quantizer, codes: Codes, ids: Integers) -> bytes:
        """Write the file of quantized Gaussians; `ids` are indices into the map's ids."""
        # order: falling energy, then falling size, then cells row by row
        order = np.lexsort((codes.cell[:, 0], codes.cell[:, 1], -codes.size, -codes.energy))
        codes, ids = codes.select(order), ids[order]
        coder, layers, entries = LayerCoder(quantizer, self.channels, self.regions), [], []
        starts = [*np.unique(-codes.energy, return_index=True)[1].tolist(), len(ids)]
        groups = [slice(*ends) for ends in itertools.pairwise(starts)]
        for layer in _join_groups(groups, len(ids)):
            writer, energy = Writer(), int(codes.energy[layer[0].start])
            coder.write(writer, [(codes.select(group), ids[group]) for group in layer])
            # a stream has no zeros at its end, but a layer's length limits the number of its Gaussians: pad it
            count = layer[-1].stop - layer[0].start
            layers.append(writer.finish().ljust(-(-(count - _FREE_GAUSSIANS) // 8), b"\0"))
            entries.append((energy, len(layers[-1])))
        header = Header(self.size, self.channels, quantizer.qp, coder.num_regions, tuple(entries))
        return pack(header, self.region_map, layers)


def _check_field(field: GaussianField) -> None:
    """Validate the values, which may have changed since the field was made, and the limits of a file."""
    check_floating("means", field.means.detach().float())
    check_cholesky("cholesky", field.cholesky.detach().float())
    check_floating("colors", field.merged_colors().detach().float())
    channels = field.colors.shape[-1]
    check_count("pixels per side", max(field.size), 1, MAX_SIDE)
    check_count("channels", channels, 1, MAX_CHANNELS)
    check_count("number of Gaussians", field.num_gaussians, 1, max_gaussians(channels))


def _black_field(field: GaussianField, regions: RegionMap | None) -> GaussianField:
    """Return one black Gaussian: a file holds at least one."""
    height, width = field.size
    region = None if regions is None else regions.labels[height // 2, width // 2][None]
    centre, color = torch.tensor([[0.5 * width, 0.5 * height]]), torch.zeros(1, field.colors.shape[-1])
    return GaussianField(centre, torch.tensor([[1.0, 0.0, 1.0]]), color, region, size=field.size)


def _join_groups(groups: list[slice], count: int) -> list[list[slice]]:
    """Join groups into layers with enough of the `count` Gaussians: each layer has overhead."""
    layers: list[list[slice]] = []
    least = max(_MIN_GAUSSIANS, _MIN_SHARE * count)
    for group in groups:
        first = layers[-1][0].start if layers else 0
        if layers and min(group.start - first, count - group.start) < least:
            layers[-1].append(group)
        else:
            layers.append([group])
    return layers


@brief
class Decoded(NamedTuple):
    """The scene of a file, how many of its layers were read, and how many it has."""

    scene: Scene
    layers: int
    num_layers: int


def decode(data: bytes, *, max_bytes: int | None = None) -> Decoded:
    """Read a `.kcgs` file, or the coarser scene that its first bytes hold.

    Args:
        data: the file, or a beginning of it that has the whole first layer.
        max_bytes: read at most this many bytes from the beginning.

    Returns:
        The scene (float32, on the CPU, bit for bit the same on every machine; without a map if the file has none), how
        many layers were read, and how many the file has.

    Raises:
        TypeError: an argument of the wrong type.
        CodecError: a ValueError; the file is damaged, no scene, or too short to hold a layer.

    Example:
        >>> from kcgs.codec import encode
        >>> data = encode(Scene(GaussianField.random(800, (32, 48), seed=0)))
        >>> whole, part = decode(data), decode(data, max_bytes=len(data) // 2)
        >>> whole.layers == whole.num_layers, part.scene.num_gaussians < whole.scene.num_gaussians
        (True, True)
    """
    if not isinstance(data, bytes | bytearray | memoryview):
        raise InvalidArgumentType("data", "bytes", type(data).__name__)
    if max_bytes is not None:
        max_bytes = check_count("max_bytes", max_bytes)
    header, region_map, layers = unpack(bytes(data[:max_bytes]))
    regions = None
    if header.regions > 1:
        regions = decode_region_map(region_map, header.size, header.regions)
    coder = LayerCoder(Quantizer(header.qp, header.size), header.channels, regions)
    parts, ids, remaining = [], [], max_gaussians(header.channels)
    for (energy, _), layer in zip(header.layers, layers, strict=False):
        max_count = min(8 * len(layer) + _FREE_GAUSSIANS, remaining)
        for gaussians, positions in coder.read(Reader(layer), energy, max_count):
            parts.append(gaussians)
            ids.append(positions)
            remaining -= len(positions)
    means, cholesky, colors = (torch.from_numpy(np.concatenate(numbers)) for numbers in zip(*parts, strict=True))
    region_ids = None if regions is None else regions.ids[torch.from_numpy(np.concatenate(ids))]
    field = GaussianField(means, cholesky, colors, region_ids, size=header.size)
    return Decoded(Scene(field, regions), len(layers), len(header.layers))
