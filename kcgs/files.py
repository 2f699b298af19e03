"""Scenes in files, of the format that the suffix names."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from kcgs import storage, zoo
from kcgs._atomic import write_file
from kcgs.codec import CodecError, decode, encode
from kcgs.errors import InvalidArgument
from kcgs.scene import Scene, check_type


def save(
    path: str | os.PathLike[str],
    scene: Scene,
    *,
    image: Any = None,
    quality: float | None = None,
    target_bytes: int | None = None,
    target_psnr: float | None = None,
    objective: str | None = None,
    seed: int | None = None,
) -> int:
    """Write a scene. The file appears whole or not at all, and the same arguments give the same bytes.

    Convention: a .safetensors file keeps every bit, and takes none of the keywords. A .kcgs file is rounded, and keeps
    no metadata. With the image that the scene shows, :func:`kcgs.rate.compress` writes it, so that Gaussians make up
    for each other's rounding; else :func:`kcgs.codec.encode`.

    Args:
        path: ends in .safetensors or in .kcgs; its folder must exist.
        scene: N Gaussians, or (.safetensors only) a batch of them.
        image: what :func:`kcgs.fit` takes, of the scene's size and channels.
        quality: PSNR in dB of the file's render against the scene's. None: with an image, so much that the file is
            nearly as good as the scene; else 46.
        target_bytes: the most bytes of the file, in place of `quality`.
        target_psnr: in dB against the image, in place of both.
        objective: l2 or ms-ssim, what is lowered with an image. None: ms-ssim with `target_bytes`, else l2.
        seed: of the order in which Gaussians are rounded, with an image. None: 0.

    Returns:
        Size of the file in bytes.

    Raises:
        TypeError: no scene.
        ValueError: another suffix, values that are not finite, l11 or l22 not positive, sizes above 2**20, a batch
            of label maps that does not fit the field; a keyword that the file does not take, or a value that
            :func:`kcgs.rate.compress` refuses.
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
    path, scene = _check_suffix(Path(path)), check_type(scene)
    goal: dict[str, Any] = {"quality": quality, "target_bytes": target_bytes}
    refinement: dict[str, Any] = {"target_psnr": target_psnr, "objective": objective, "seed": seed}
    if path.suffix == ".safetensors":
        _check_none({"image": image, **goal, **refinement}, "for a .safetensors file, which keeps every bit")
        return write_file(path, storage.serialize(scene))
    if image is None:
        _check_none(refinement, "without an image")
        return write_file(path, encode(scene, **goal))
    from kcgs.rate import compress  # which loads all of fitting: 240 ms

    return write_file(path, compress(scene, image, **goal, **{**refinement, "seed": seed or 0}).data)


def load(path: str | os.PathLike[str]) -> Scene:
    """Read a scene.

    Args:
        path: a .safetensors file that :func:`save` wrote, or a whole .kcgs file; the beginning of one is read by
            :func:`kcgs.codec.decode`. "zoo:NAME" is a scene that comes with the package.

    Returns:
        The scene, on the CPU; from .safetensors bit for bit as saved. Region ids and labels are int64.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: another suffix; the file is damaged, no scene, or of another format version; the message names
            the path. No such scene in the zoo.

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
        >>> load("zoo:chelsea-500").num_gaussians
        500
    """
    path = zoo.locate(path)
    if not path.exists():
        raise FileNotFoundError(f"no such file: {path}")
    read = _READERS[_check_suffix(path).suffix]
    data = path.read_bytes()
    try:
        return read(data)
    except ValueError as error:
        raise ValueError(f"cannot load {path}: {error}") from error


def _decode_whole(data: bytes) -> Scene:
    decoded = decode(data)
    if decoded.layers < decoded.num_layers:
        raise CodecError(
            f"it ends early, with {decoded.layers} of {decoded.num_layers} layers; kcgs decode renders what is there"
        )
    return decoded.scene


_READERS = {".safetensors": storage.deserialize, ".kcgs": _decode_whole}


def _check_suffix(path: Path) -> Path:
    if path.suffix not in _READERS:
        raise ValueError(f"path must end in {' or '.join(_READERS)}; got {str(path)!r}")
    return path


def _check_none(arguments: dict[str, Any], reason: str) -> None:
    """Refuse arguments that a file does not take."""
    for name, value in arguments.items():
        if value is not None:
            raise InvalidArgument(name, f"None {reason}", "an image" if name == "image" else repr(value))
