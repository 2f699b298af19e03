"""Scenes as .safetensors files, bit for bit; docs/files.md has the format."""

from __future__ import annotations

import json
import math
import os
import zlib
from functools import cached_property
from typing import Any

import numpy as np
import safetensors
import safetensors.torch
import torch
from torch import Tensor

from kcgs._check import check_count
from kcgs.maps import RegionMap, softness_from_plain, softness_to_plain
from kcgs.nn import GaussianField, used_rows
from kcgs.scene import Scene

FORMAT = "kcgs.scene"
"""Name of the one metadata entry, a JSON object."""
VERSION = 1
MAX_SIDE = 1 << 20  # pixels; on longer sides float32 centres cannot resolve tenths of a pixel
_REQUIRED = ("means", "cholesky", "colors")
_OPTIONAL = ("opacities", "region_ids", "labels")
_FLOATS = (torch.float32, torch.float64)
_INTEGERS = {
    str(dtype).removeprefix("torch."): dtype for dtype in (torch.uint8, torch.uint16, torch.int32, torch.int64)
}


def serialize(scene: Scene) -> bytes:
    """Write a scene as the bytes of a .safetensors file."""
    from kcgs import __version__

    field, regions = scene.field, scene.regions
    header: dict[str, Any] = {"version": VERSION, "kcgs_version": __version__, "size": scene.size}
    header["notes"] = scene.metadata
    tensors = {
        # copy: safetensors refuses tensors that share a storage
        name: tensor.detach().cpu().clone(memory_format=torch.contiguous_format)
        for name in (*_REQUIRED, "opacities")
        if (tensor := getattr(field, name)) is not None
    }
    if field.region_ids is not None:
        tensors["region_ids"] = _narrow(field.region_ids.cpu())
    if regions is not None:
        header["softness"] = softness_to_plain(regions.softness)
        labels = _narrow(regions.labels.cpu()).numpy()
        header["labels"] = {"dtype": labels.dtype.name, "shape": labels.shape}
        tensors["labels"] = torch.frombuffer(bytearray(_deflate(labels)), dtype=torch.uint8)
    _assemble(tensors, json.loads(json.dumps(header)))  # raises where `deserialize` would
    header["checksum"] = _checksum(tensors, header)
    return safetensors.torch.save(tensors, {FORMAT: json.dumps(header, sort_keys=True)})


def deserialize(data: bytes) -> Scene:
    """Read the bytes of a .safetensors file; raise ValueError if they are damaged or no scene."""
    try:
        tensors = safetensors.torch.load(data)
        notes = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")]).get("__metadata__", {})
        if FORMAT not in notes:
            raise ValueError(f"its metadata must have an entry {FORMAT!r}; got {sorted(notes)}")
        return _assemble(tensors, json.loads(notes[FORMAT]))
    except KeyError as error:
        raise ValueError(f"its {FORMAT!r} must have an entry {error}") from error
    except (safetensors.SafetensorError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise ValueError(str(error)) from error


class Shard:
    """A batch of scenes in a .safetensors file; its tensors are mapped into memory and read on use.

    The checksum is not verified, since this would read the whole file; `deserialize` verifies it.
    """

    def __init__(self, tensors: dict[str, Tensor], header: dict[str, Any]) -> None:
        self.tensors, self._header = tensors, header
        height, width = header["size"]
        self.size: tuple[int, int] = height, width
        self.metadata: dict[str, str] = header["notes"]

    @property
    def layout(self) -> str:
        """The properties that all shards of a data set must share, in words."""
        _, rows, channels = self.tensors["colors"].shape
        return f"{rows} rows, {channels} channels, {'' if 'region_ids' in self.tensors else 'no '}regions"

    @cached_property
    def _regions(self) -> RegionMap | None:
        """The label maps; they are compressed together, so all are read at once."""
        if "labels" not in self.tensors:
            return None
        labels = _inflate(self.tensors["labels"], **self._header["labels"])
        return RegionMap(labels, softness_from_plain(self._header["softness"]))

    def scene(self, index: int) -> Scene:
        """Return one of the scenes, without unused rows."""
        rows = used_rows(self.tensors["colors"][index])
        means, cholesky, colors = (self.tensors[name][index][rows] for name in _REQUIRED)
        ids = self.tensors["region_ids"][index][rows].long() if "region_ids" in self.tensors else None
        field = GaussianField(means, cholesky, colors, ids, size=self.size)
        regions = self._regions
        if regions is not None and regions.num_maps is not None:
            regions = regions[index if regions.num_maps > 1 else 0]
        return Scene(field, regions)


def map_file(path: str | os.PathLike[str]) -> Shard:
    """Map a batch of scenes in a .safetensors file into memory; raise ValueError if the file has no batch."""
    try:
        with safetensors.safe_open(path, "pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            notes = file.metadata() or {}
        if not {*_REQUIRED} <= tensors.keys() or tensors["means"].ndim != 3:
            raise ValueError(f"it must hold {', '.join(_REQUIRED)} of a batch; got {sorted(tensors)}")
        if "opacities" in tensors:
            raise ValueError("shards hold no opacities: kcgs.data.save_shard merges them into the colours")
        header = json.loads(notes[FORMAT])
        _check_version(header)
        return Shard(tensors, header)
    except (KeyError, safetensors.SafetensorError, TypeError, ValueError) as error:
        raise ValueError(f"{path} holds no batch of scenes: {error}") from error


def _assemble(tensors: dict[str, Tensor], header: Any) -> Scene:
    """Validate the contents of a file and copy them into a scene."""
    _check_version(header)
    missing, unknown = {*_REQUIRED} - tensors.keys(), tensors.keys() - {*_REQUIRED, *_OPTIONAL}
    if missing or unknown:
        raise ValueError(f"it must hold {', '.join(_REQUIRED)}; missing: {sorted(missing)}, unknown: {sorted(unknown)}")
    for name, tensor in tensors.items():
        allowed = tuple(_INTEGERS.values()) if name in ("region_ids", "labels") else _FLOATS
        if tensor.dtype not in allowed:
            raise ValueError(f"{name} must have a dtype among {allowed}; got {tensor.dtype}")
    # the checksum is optional: an editor may leave it out, and earlier files have none
    if "checksum" in header and header.pop("checksum") != _checksum(tensors, header):
        raise ValueError("its checksum is wrong: the file is damaged, or was edited and keeps the old checksum")
    height, width = header["size"]
    size = check_count("height", height, 1, MAX_SIDE), check_count("width", width, 1, MAX_SIDE)
    means, cholesky, colors = (tensors[name] for name in _REQUIRED)
    ids = tensors["region_ids"].long() if "region_ids" in tensors else None
    field = GaussianField(means, cholesky, colors, ids, tensors.get("opacities"), size=size)
    regions = None
    if "labels" in tensors:
        softness = softness_from_plain(header["softness"])
        regions = RegionMap(_inflate(tensors["labels"], **header["labels"]), softness)
    return Scene(field, regions, header["notes"])


def _check_version(header: dict[str, Any]) -> None:
    if header["version"] != VERSION:
        raise ValueError(f"its version must be {VERSION}; got {header['version']!r}")


def _checksum(tensors: dict[str, Tensor], header: dict[str, Any]) -> int:
    """Return the CRC-32 of the header and the tensors: of their names, types and shapes, then of their bytes."""
    arrays = {name: tensor.numpy() for name, tensor in sorted(tensors.items())}
    contents = [header, {name: [array.dtype.name, array.shape] for name, array in arrays.items()}]
    checksum = zlib.crc32(json.dumps(contents, sort_keys=True).encode())
    for array in arrays.values():
        checksum = zlib.crc32(array.tobytes(), checksum)
    return checksum


def _narrow(integers: Tensor) -> Tensor:
    """Return integers in the smallest type that holds them."""
    highest = int(integers.max()) if integers.numel() else 0
    return integers.to(next(dtype for dtype in _INTEGERS.values() if highest <= torch.iinfo(dtype).max))


def _deflate(labels: np.ndarray[Any, Any]) -> bytes:
    """Compress the differences of each row from the row above; they wrap around in the dtype of the labels."""
    steps = np.diff(labels, axis=-2, prepend=np.zeros_like(labels[..., :1, :]))
    return zlib.compress(steps.tobytes(), 9)


def _inflate(data: Tensor, dtype: str, shape: list[int]) -> Tensor:
    if dtype not in _INTEGERS or len(shape) not in (2, 3):
        raise ValueError(f"labels must be of 2 or 3 dimensions, {', '.join(_INTEGERS)}; got {dtype!r} of {shape!r}")
    size = math.prod(check_count("sides of labels", side, 1, MAX_SIDE) for side in shape) * np.dtype(dtype).itemsize
    try:
        raw = zlib.decompressobj().decompress(data.numpy().tobytes(), size + 1)
    except zlib.error as error:
        raise ValueError(f"labels must be a zlib stream; {error}") from None
    if len(raw) != size:
        raise ValueError(f"labels must be a zlib stream of {size} bytes; got {len(raw)} or more")
    steps = np.frombuffer(raw, dtype).reshape(shape)
    return torch.from_numpy(np.add.accumulate(steps, axis=-2, dtype=steps.dtype)).long()
