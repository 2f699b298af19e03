"""Save and load scenes; the suffix selects the format of the file."""

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
    min_sigma: float | None = None,
) -> int:
    """Write a scene to a file, atomically; the same arguments give the same bytes.

    Convention: a .safetensors file is exact to the bit, and takes no keywords. A .kcgs file is rounded, and stores no
    metadata. If `image` is given, :func:`kcgs.rate.compress` writes the .kcgs file, so that Gaussians correct each
    other's rounding errors; otherwise :func:`kcgs.codec.encode` does.

    Args:
        path: ends in .safetensors or in .kcgs; its folder must exist.
        scene: N Gaussians, or (.safetensors only) a batch of scenes.
        image: the image that the scene was fitted to, as in :func:`kcgs.fit`, of the scene's size and channels.
        quality: PSNR in dB of the file's render against the scene's render. None: 46; with an image, a quality at
            which the file is nearly as good as the scene.
        target_bytes: largest size of the file in bytes, in place of `quality`.
        target_psnr: PSNR in dB against the image, in place of both.
        objective: l2 or ms-ssim, lowered if there is an image. None: ms-ssim with `target_bytes`, else l2.
        seed: of the order in which Gaussians are rounded, with an image. None: 0.
        min_sigma: least standard deviation of a Gaussian in pixels, before it is rounded, with an image. None: 0.

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
    refinement: dict[str, Any] = {
        "target_psnr": target_psnr, "objective": objective, "seed": seed, "min_sigma": min_sigma
    }  # fmt: skip
    if path.suffix == ".safetensors":
        _check_none({"image": image, **goal, **refinement}, "for a .safetensors file, which keeps every bit")
        return write_file(path, storage.serialize(scene))
    if image is None:
        _check_none(refinement, "without an image")
        return write_file(path, encode(scene, **goal))
    from kcgs.rate import compress  # which loads all of fitting: 240 ms

    refinement |= {"seed": seed or 0, "min_sigma": min_sigma or 0.0}
    return write_file(path, compress(scene, image, **goal, **refinement).data)


def load(path: str | os.PathLike[str]) -> Scene:
    """Read a scene.

    Args:
        path: a .safetensors file that :func:`save` wrote, or a complete .kcgs file; :func:`kcgs.codec.decode` reads
            the beginning of a .kcgs file. "zoo:NAME" is a scene that comes with the package.

    Returns:
        The scene, on the CPU; from .safetensors bit for bit as saved. Region ids and labels are int64.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: another suffix; the file is damaged, no scene, or of another format version (the message names the
            path); the zoo has no such scene.

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
