"""Scenes on disk: a field and its label map in one .safetensors file.

The file holds the tensors ``means``, ``cholesky``, ``colors`` and, where the scene has them, ``opacities``
(float32 or float64), ``region_ids`` and ``labels`` (the smallest of uint8, uint16, int32, int64 that holds
them). Its metadata are ``format``, ``format_version``, ``kcgs_version``, ``height``, ``width``, ``softness``
(where there are labels) and what the caller adds, each key behind ``user.``.

Format version 2 is written only for what version 1 cannot say: where pairs of regions have widths of their own,
``softness`` is a JSON list of [id, id, width]; where the label map is finer than the picture, ``supersample`` says how
many labels there are along a side of a pixel, and ``labels`` is the fine map.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from kcgs._atomic import atomic_path
from kcgs.functional import RegionMap
from kcgs.functional.regions import PairWidths
from kcgs.nn import GaussianField

FORMAT = "kcgs.scene"
FORMAT_VERSIONS = ("1", "2")
MAX_SIDE = 1 << 20  # pixels; past it float32 centres cannot tell tenths of a pixel apart
_SUFFIX = ".safetensors"
_COMPRESSED = ".kcgs"
_USER = "user."
_REQUIRED = ("means", "cholesky", "colors")
_INTEGER = ("region_ids", "labels")
_FLOATS = (torch.float32, torch.float64)
_PACKED = (torch.uint8, torch.uint16, torch.int32, torch.int64)


class Scene(NamedTuple):
    """What a file holds: a field, the label map to draw it with (None: one region), the caller's notes."""

    field: GaussianField
    regions: RegionMap | None
    metadata: dict[str, str]


def save(
    path: str | os.PathLike[str],
    field: GaussianField,
    regions: RegionMap | Tensor | None = None,
    *,
    metadata: Mapping[str, str] | None = None,
) -> int:
    """Write a scene; the file appears whole or not at all, and the same scene gives the same bytes.

    Args:
        path: ends in .safetensors; its folder must exist.
        field: N Gaussians, or a batch of them.
        regions: label map of any size (a Tensor means hard contours); None: not stored.
        metadata: notes to keep with the scene.

    Returns:
        Size of the file in bytes.

    Raises:
        TypeError: an argument of the wrong type.
        ValueError: another suffix, values that are not finite, l11 or l22 not positive, sizes above 2**20, a
            batch of label maps that does not fit the field.
        FileNotFoundError: the folder does not exist.

    Example:
        >>> import tempfile
        >>> field = GaussianField.random(10, (32, 48), seed=0)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     size = save(f"{folder}/scene.safetensors", field, metadata={"title": "ten blobs"})
        ...     scene = load(f"{folder}/scene.safetensors")
        >>> torch.equal(scene.field.colors, field.colors), scene.regions, scene.metadata
        (True, None, {'title': 'ten blobs'})
    """
    path = Path(path)
    if path.suffix != _SUFFIX:
        raise ValueError(f"path must end in {_SUFFIX}; got {str(path)!r}")
    content = _serialize(field, regions, metadata)
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)
    return len(content)


def scene_bytes(
    field: GaussianField,
    regions: RegionMap | Tensor | None = None,
    *,
    metadata: Mapping[str, str] | None = None,
) -> int:
    """Size in bytes of the file that :func:`save` would write.

    Args:
        field: N Gaussians, or a batch of them.
        regions: label map, or None.
        metadata: notes to keep with the scene.

    Returns:
        Bytes.

    Raises:
        TypeError, ValueError: as :func:`save`.

    Example:
        >>> field = GaussianField.random(1000, (32, 48), seed=0)
        >>> scene_bytes(field) > 1000 * 8 * 4
        True
    """
    return len(_serialize(field, regions, metadata))


def load(path: str | os.PathLike[str]) -> Scene:
    """Read a scene that :func:`save` wrote, or a compressed file.

    Args:
        path: the file; what ends in .kcgs is decoded (:func:`kcgs.codec.decode`) and must be whole.

    Returns:
        Field, regions and metadata, on the CPU, bit for bit as saved; region ids and labels are int64.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is damaged, no scene, or of another format version; the message names the path.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = f"{folder}/scene.safetensors"
        ...     _ = save(path, GaussianField.random(10, (32, 48), seed=0), torch.zeros(32, 48).long())
        ...     field, regions, metadata = load(path)
        >>> field.size, regions.num_regions, metadata
        ((32, 48), 1, {})
    """
    path = Path(path)
    with path.open("rb"):  # safetensors' own errors for a file that cannot be opened do not name it
        pass
    if path.suffix == _COMPRESSED:
        return _load_compressed(path)
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            notes = file.metadata() or {}
            _check_format(notes)
            names = file.keys()
            tensors = {name: file.get_tensor(name) for name in names}
        return _assemble(tensors, notes)
    except (safetensors.SafetensorError, TypeError, ValueError) as error:
        raise ValueError(f"cannot load {path}: {error}") from error


def _load_compressed(path: Path) -> Scene:
    from kcgs.codec import CodecError, decode

    try:
        decoded = decode(path.read_bytes())
    except CodecError as error:
        raise ValueError(f"cannot load {path}: {error}") from error
    if decoded.layers < decoded.num_layers:
        raise ValueError(
            f"cannot load {path}: it ends early, with {decoded.layers} of {decoded.num_layers} layers; "
            "kcgs decode draws what is there"
        )
    return Scene(decoded.field, decoded.regions, {})


def _serialize(field: GaussianField, regions: RegionMap | Tensor | None, metadata: Mapping[str, str] | None) -> bytes:
    if not isinstance(field, GaussianField):
        raise TypeError(f"field must be a GaussianField; got {type(field).__name__}")
    if isinstance(regions, Tensor):
        regions = RegionMap.from_labels(regions)
    elif regions is not None and not isinstance(regions, RegionMap):
        raise TypeError(f"regions must be a RegionMap, a label map or None; got {type(regions).__name__}")
    notes = _describe(field, regions, metadata)
    tensors = {name: getattr(field, name) for name in (*_REQUIRED, "opacities", "region_ids")}
    if regions is not None:
        tensors["labels"] = regions.fine_labels
    packed = {}
    for name, tensor in tensors.items():
        if tensor is not None:
            tensor = tensor.detach().cpu()
            # a copy, since safetensors refuses tensors that are views of one storage
            packed[name] = (_pack(tensor) if name in _INTEGER else tensor).clone(memory_format=torch.contiguous_format)
    _assemble(packed, notes)  # what could not be loaded is not written
    return _sort_header(safetensors.torch.save(packed, notes))


def _describe(field: GaussianField, regions: RegionMap | None, metadata: Mapping[str, str] | None) -> dict[str, str]:
    from kcgs import __version__

    height, width = field.size
    notes = {"format": FORMAT, "format_version": FORMAT_VERSIONS[0], "kcgs_version": __version__}
    notes |= {"height": str(height), "width": str(width)}
    if regions is not None:
        notes |= _describe_regions(regions)
    if metadata is not None and not isinstance(metadata, Mapping):
        raise TypeError(f"metadata must map str to str; got {type(metadata).__name__}")
    for key, value in (metadata or {}).items():
        if not isinstance(key, str) or not isinstance(value, str):
            raise TypeError(f"metadata must map str to str; got {key!r}: {value!r}")
        notes[_USER + key] = value
    return notes


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


def _sort_header(content: bytes) -> bytes:
    """Rewrite the header with its metadata in order: safetensors emits them in a random one."""
    start = 8 + int.from_bytes(content[:8], "little")
    header = json.loads(content[8:start])
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
    lead = tensors["means"].shape[:-1]
    for name in ("cholesky", "colors"):
        shape = tensors[name].shape
        if shape[:-1] != lead or shape[-1] == 0:
            raise ValueError(f"{name} must have shape {(*lead, '...')} to fit means; got {tuple(shape)}")
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
    regions = None if labels is None else _assemble_regions(field, labels, notes)
    user = {key.removeprefix(_USER): value for key, value in notes.items() if key.startswith(_USER)}
    return Scene(field, regions, dict(sorted(user.items())))


def _assemble_regions(field: GaussianField, labels: Tensor, notes: Mapping[str, str]) -> RegionMap:
    supersample = 1
    if notes["format_version"] != FORMAT_VERSIONS[0] and "supersample" in notes:
        supersample = _read_side("supersample", notes)
    regions = RegionMap.from_labels(labels, _read_softness(notes), supersample=supersample)
    if max(labels.shape[-2:]) > MAX_SIDE:
        raise ValueError(f"labels must be at most {MAX_SIDE} pixels a side; got {tuple(labels.shape[-2:])}")
    images = field.means.shape[0] if field.means.ndim == 3 else 1
    if labels.ndim == 3 and labels.shape[0] not in (1, images):
        raise ValueError(f"labels must hold 1 map or one for each of {images} images; got {labels.shape[0]}")
    return regions


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
