"""Label maps on disk."""

import os
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from kcgs._atomic import atomic_path
from kcgs._labels import check_labels, read_labels

from .colors import label_colors


def load_labels(path: str | os.PathLike[str], *, rgb_ids: bool = False, threshold: float | None = None) -> Tensor:
    """Read a label map.

    The kind of file decides what a label is:

    - palette images such as DAVIS 2017: the palette index, whatever its colour;
    - grey of 1, 8 or 16 bits, and integer TIFF: the stored value, so a 0/255 mask has the labels 0 and 255;
    - RGB and RGBA: every distinct colour is a region, numbered from 0 in the order of R, then G, B and A; all
      fully transparent pixels count as one colour;
    - .npy: an integer or boolean array of two dimensions.

    Args:
        path: PNG, TIFF, GIF, BMP or .npy; no format that changes pixel values.
        rgb_ids: colours are ids, R + 256 G + 65536 B, as in COCO's panoptic maps; there may be any number of ids.
        threshold: for a mask with soft edges: pixels with larger values have label 1, others 0; colours count by their
            luma.

    Returns:
        :math:`(H, W)` int64, non-negative; ids need not be consecutive.

    Raises:
        OSError: ``path`` does not exist, or is a folder.
        TypeError: the file holds floats.
        ValueError: the file cannot be read, is lossy or a photo (more than 4,096 colours), holds negative values or
            another number of dimensions, or is a mask with soft edges; the message then has a ``threshold`` for it.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_labels(f"{folder}/map.png", torch.tensor([[0, 0, 7], [3, 3, 7]]))
        ...     load_labels(f"{folder}/map.png").tolist()
        [[0, 0, 7], [3, 3, 7]]
    """
    return read_labels(path, rgb_ids, threshold)


def save_labels(path: str | os.PathLike[str], labels: Tensor, *, rgb_ids: bool = False) -> None:
    """Write a label map losslessly and atomically.

    A .png is an 8-bit palette image whose index is the label if all ids are below 256, else 16-bit grey.

    Args:
        path: the file to write, .png or .npy; its folder must exist.
        labels: :math:`(H, W)` integer, non-negative; at most 65535 for .png, 2**24 - 1 with ``rgb_ids``.
        rgb_ids: write an RGB .png whose colours are ids, as `load_labels` reads them with ``rgb_ids``.

    Raises:
        FileNotFoundError: the folder of ``path`` does not exist.
        TypeError: ``labels`` is no integer tensor.
        ValueError: ``labels`` has another shape, negative ids or ids too large for the format, or the suffix is
            unknown.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_labels(f"{folder}/map.npy", torch.tensor([[0, 100_000]]))
        ...     load_labels(f"{folder}/map.npy").tolist()
        [[0, 100000]]
    """
    suffix = Path(path).suffix.lower()
    if suffix != ".png" and (rgb_ids or suffix != ".npy"):
        raise ValueError(f"path must end in .png{'' if rgb_ids else ' or .npy'}; got {str(path)!r}")
    values = check_labels("labels", labels, dims=(2,)).cpu().numpy()
    highest = int(values.max())
    if suffix == ".npy":
        with atomic_path(path) as temporary, Path(temporary).open("wb") as file:  # np.save would add .npy to .NPY
            np.save(file, values.astype(np.min_scalar_type(highest)), allow_pickle=False)
        return
    most = (1 << 24) - 1 if rgb_ids else 65535
    if highest > most:
        raise ValueError(f"labels for a .png must be at most {most}; got {highest}: renumber or save as .npy")
    if rgb_ids:
        values = np.stack([(values >> shift).astype(np.uint8) for shift in (0, 8, 16)], -1)
    stored = Image.fromarray(values.astype(np.uint8 if rgb_ids or highest < 256 else np.uint16))
    if highest < 256 and not rgb_ids:
        stored.putpalette((label_colors(256) * 255 + 0.5).floor().to(torch.uint8).flatten().tolist())
    with atomic_path(path) as temporary:
        stored.save(temporary, format="PNG")
