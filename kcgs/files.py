"""Scenes in files, of the format that the suffix names."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from kcgs import storage
from kcgs._atomic import atomic_path
from kcgs.codec import CodecError, decode, encode
from kcgs.scene import Scene, check_type


def save(path: str | os.PathLike[str], scene: Scene) -> int:
    """Write a scene. The file appears whole or not at all, and the same scene gives the same bytes.

    Args:
        path: ends in .safetensors, which keeps every bit, or in .kcgs, which rounds as
            :func:`kcgs.codec.encode` does by default and keeps no metadata; its folder must exist.
        scene: N Gaussians, or (.safetensors only) a batch of them.

    Returns:
        Size of the file in bytes.

    Raises:
        TypeError: no scene.
        ValueError: another suffix, values that are not finite, l11 or l22 not positive, sizes above 2**20, a batch
            of label maps that does not fit the field.
        FileNotFoundError: the folder does not exist.

    Example:
        >>> import tempfile, torch
        >>> from kcgs import GaussianField
        >>> scene = Scene(GaussianField.random(10, (32, 48), seed=0), metadata={"title": "ten blobs"})
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     size = save(f"{folder}/scene.safetensors", scene)
        ...     loaded = load(f"{folder}/scene.safetensors")
        >>> torch.equal(loaded.field.colors, scene.field.colors), loaded.regions, loaded.metadata
        (True, None, {'title': 'ten blobs'})
    """
    path = Path(path)
    content = _format(path).write(check_type(scene))
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)
    return len(content)


def load(path: str | os.PathLike[str]) -> Scene:
    """Read a scene.

    Args:
        path: a .safetensors file that :func:`save` wrote, or a whole .kcgs file; the beginning of one is read by
            :func:`kcgs.codec.decode`.

    Returns:
        The scene, on the CPU; from .safetensors bit for bit as saved. Region ids and labels are int64.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: another suffix; the file is damaged, no scene, or of another format version; the message names
            the path.

    Example:
        >>> import tempfile, torch
        >>> from kcgs import GaussianField
        >>> field = GaussianField.random(10, (32, 48), seed=0)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = f"{folder}/scene.safetensors"
        ...     _ = save(path, Scene(field, torch.zeros(32, 48).long()))
        ...     scene = load(path)
        >>> scene.size, scene.regions.num_regions, scene.metadata
        ((32, 48), 1, {})
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"no such file: {path}")
    file_format = _format(path)
    data = path.read_bytes()
    try:
        return file_format.read(data)
    except ValueError as error:
        raise ValueError(f"cannot load {path}: {error}") from error


class _Format(NamedTuple):
    write: Callable[[Scene], bytes]
    read: Callable[[bytes], Scene]


def _decode_whole(data: bytes) -> Scene:
    decoded = decode(data)
    if decoded.layers < decoded.num_layers:
        raise CodecError(
            f"it ends early, with {decoded.layers} of {decoded.num_layers} layers; kcgs decode renders what is there"
        )
    return decoded.scene


_FORMATS = {
    ".safetensors": _Format(storage.serialize, storage.deserialize),
    ".kcgs": _Format(encode, _decode_whole),
}


def _format(path: Path) -> _Format:
    if path.suffix not in _FORMATS:
        raise ValueError(f"path must end in {' or '.join(_FORMATS)}; got {str(path)!r}")
    return _FORMATS[path.suffix]
