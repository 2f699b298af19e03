"""Scenes as .safetensors files, bit for bit; docs/files.md has the format.

A version is written only for what those before it cannot say: 2 has widths of pairs and finer maps, 3 deflated maps.
"""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import safetensors
import safetensors.torch
import torch
from torch import Tensor

from kcgs.functional import PairWidths, RegionMap
from kcgs.nn import GaussianField
from kcgs.scene import Scene

FORMAT = "kcgs.scene"
FORMAT_VERSIONS = ("1", "2", "3")
MAX_SIDE = 1 << 20  # pixels; past it float32 centres cannot tell tenths of a pixel apart
_USER = "user."
_REQUIRED = ("means", "cholesky", "colors")
_INTEGER = ("region_ids", "labels")
_FLOATS = (torch.float32, torch.float64)
_PACKED = (torch.uint8, torch.uint16, torch.int32, torch.int64)
_DEFLATED = "labels_deflate"
_LEAST = 1024  # bytes that a deflated map must save


def serialize(scene: Scene) -> bytes:
    """Write a scene as the bytes of a .safetensors file."""
    notes = _describe(scene)
    tensors = {name: getattr(scene.field, name) for name in (*_REQUIRED, "opacities", "region_ids")}
    if scene.regions is not None:
        if scene.regions.contours == "crisp":
            raise ValueError('regions must have scaled contours; got crisp ones: render(contours="crisp") makes them')
        tensors["labels"] = scene.regions.fine_labels
    packed = {}
    for name, tensor in tensors.items():
        if tensor is not None:
            tensor = tensor.detach().cpu()
            # a copy, since safetensors refuses tensors that are views of one storage
            packed[name] = (_pack(tensor) if name in _INTEGER else tensor).clone(memory_format=torch.contiguous_format)
    _assemble(packed, notes)  # what could not be loaded is not written
    if "labels" in packed:
        labels = packed["labels"]
        deflated = _deflate(labels)
        if len(deflated) + _LEAST < labels.numel() * labels.element_size():
            del packed["labels"]
            packed[_DEFLATED] = torch.frombuffer(bytearray(deflated), dtype=torch.uint8)
            notes |= {"labels_shape": json.dumps(list(labels.shape)), "labels_type": labels.numpy().dtype.name}
            notes["format_version"] = FORMAT_VERSIONS[2]
    return _sort_header(safetensors.torch.save(packed, notes))


def deserialize(data: bytes) -> Scene:
    """Read the bytes of a .safetensors file; ValueError says what is wrong with them."""
    try:
        tensors = safetensors.torch.load(data)
        notes = _header(data).get("__metadata__", {})
        _check_format(notes)
        if notes["format_version"] == FORMAT_VERSIONS[2]:
            tensors["labels"] = _inflate(tensors.pop(_DEFLATED, None), notes)
        return _assemble(tensors, notes)
    except (safetensors.SafetensorError, TypeError, ValueError) as error:
        raise ValueError(str(error)) from error


def _header(content: bytes) -> dict[str, Any]:
    header: dict[str, Any] = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
    return header


def _describe(scene: Scene) -> dict[str, str]:
    from kcgs import __version__

    height, width = scene.size
    notes = {"format": FORMAT, "format_version": FORMAT_VERSIONS[0], "kcgs_version": __version__}
    notes |= {"height": str(height), "width": str(width)}
    if scene.regions is not None:
        notes |= _describe_regions(scene.regions)
    return notes | {_USER + key: value for key, value in scene.metadata.items()}


def _describe_regions(regions: RegionMap) -> dict[str, str]:
    notes = {}
    if isinstance(regions.softness, PairWidths):
        widths = [[*pair, width] for pair, width in regions.softness.items()]
        notes = {"softness": json.dumps(widths, separators=(",", ":")), "format_version": FORMAT_VERSIONS[1]}
    else:
        notes["softness"] = repr(regions.softness)
    if regions.supersample > 1:
        notes |= {"supersample": str(regions.supersample), "format_version": FORMAT_VERSIONS[1]}
    return notes


def _pack(integers: Tensor) -> Tensor:
    highest = int(integers.max()) if integers.numel() else 0
    return integers.to(next(dtype for dtype in _PACKED if highest <= torch.iinfo(dtype).max))


def _deflate(labels: Tensor) -> bytes:
    """Compress what each row differs by from the row above it, in the labels' own type, which wraps."""
    rows = labels.numpy()
    steps = np.diff(rows, axis=-2, prepend=np.zeros_like(rows[..., :1, :]))
    return zlib.compress(steps.astype(_little(rows.dtype)).tobytes(), 9)


def _inflate(data: Tensor | None, notes: Mapping[str, str]) -> Tensor:
    try:
        shape, dtype = json.loads(notes.get("labels_shape", "")), notes.get("labels_type", "")
        if data is None or dtype not in [str(packed).removeprefix("torch.") for packed in _PACKED]:
            raise ValueError(f"no tensor {_DEFLATED}, or one of the type {dtype!r}")
        if len(shape) not in (2, 3) or not all(type(side) is int and 0 < side <= MAX_SIDE for side in shape):
            raise ValueError(f"of shape {shape}")
        size = math.prod(shape) * np.dtype(dtype).itemsize
        unpacker = zlib.decompressobj()
        raw = unpacker.decompress(data.numpy().tobytes(), size + 1)
        if len(raw) != size or not unpacker.eof:
            raise ValueError(f"{size} bytes do not come out of it")
    except (TypeError, ValueError, OverflowError, RecursionError, zlib.error) as error:
        raise ValueError(f"{_DEFLATED} must be a deflated label map; {error}") from None
    steps = np.frombuffer(raw, _little(np.dtype(dtype))).astype(dtype).reshape(shape)
    return torch.from_numpy(np.add.accumulate(steps, axis=-2, dtype=steps.dtype))


def _little(dtype: np.dtype[Any]) -> np.dtype[Any]:
    return dtype.newbyteorder("<")


def _sort_header(content: bytes) -> bytes:
    """Rewrite the header with its metadata in order: safetensors emits them in a random one."""
    start = 8 + int.from_bytes(content[:8], "little")
    header = _header(content)
    header = {"__metadata__": dict(sorted(header.pop("__metadata__").items())), **header}
    text = json.dumps(header, ensure_ascii=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + content[start:]


def _check_format(notes: Mapping[str, str]) -> None:
    if notes.get("format") != FORMAT:
        raise ValueError(f"its format must be {FORMAT!r}; got {notes.get('format')!r}")
    version = notes.get("format_version")
    if version not in FORMAT_VERSIONS:
        raise ValueError(f"its format version must be one of {FORMAT_VERSIONS}; got {version!r}")


def _assemble(tensors: dict[str, Tensor], notes: Mapping[str, str]) -> Scene:
    """Validate what a file holds and make it a scene of its own memory."""
    missing = [name for name in _REQUIRED if name not in tensors]
    unknown = sorted(tensors.keys() - {*_REQUIRED, *_INTEGER, "opacities"})
    if missing or unknown:
        raise ValueError(f"it must hold {', '.join(_REQUIRED)}; missing: {missing}, unknown: {unknown}")
    for name, tensor in tensors.items():
        allowed = _PACKED if name in _INTEGER else _FLOATS
        if tensor.dtype not in allowed:
            raise ValueError(f"{name} must have a dtype among {allowed}; got {tensor.dtype}")
    integers = {name: tensors[name].to(torch.int64, copy=True) for name in _INTEGER if name in tensors}
    size = _read_side("height", notes), _read_side("width", notes)
    field = GaussianField(
        tensors["means"],
        tensors["cholesky"],
        tensors["colors"],
        region_ids=integers.get("region_ids"),
        opacities=tensors.get("opacities"),
        size=size,
    )
    labels = integers.get("labels")
    regions = None if labels is None else _assemble_regions(labels, notes)
    user = {key.removeprefix(_USER): value for key, value in notes.items() if key.startswith(_USER)}
    return Scene(field, regions, dict(sorted(user.items())))


def _assemble_regions(labels: Tensor, notes: Mapping[str, str]) -> RegionMap:
    supersample = 1
    if notes["format_version"] != FORMAT_VERSIONS[0] and "supersample" in notes:
        supersample = _read_side("supersample", notes)
    return RegionMap.from_labels(labels, _read_softness(notes), supersample=supersample)


def _read_softness(notes: Mapping[str, str]) -> float | dict[tuple[int, int], float]:
    text = notes.get("softness", "")
    if notes["format_version"] != FORMAT_VERSIONS[0] and text.startswith("["):
        try:
            widths = {(low, high): float(width) for low, high, width in json.loads(text)}
        except (TypeError, ValueError, OverflowError, RecursionError):
            raise ValueError(f"softness must be a list of [id, id, width]; got {text[:80]!r}") from None
        return widths
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"softness must be a number; got {notes.get('softness')!r}") from None


def _read_side(name: str, notes: Mapping[str, str]) -> int:
    text = notes.get(name, "")
    if not (text.isascii() and text.isdecimal() and len(text) < 9 and 1 <= int(text) <= MAX_SIDE):
        raise ValueError(f"{name} must be a whole number of 1 to {MAX_SIDE} pixels; got {text!r}")
    return int(text)
