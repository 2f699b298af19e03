"""Label maps on disk, and as images to look at."""

import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from kcgs._atomic import atomic_path
from kcgs._check import check_count, check_labels
from kcgs._image import as_image
from kcgs.data._decode import Array, decode
from kcgs.functional import touching_pairs

MAX_COLORS = 4096
"""An image with more distinct colours is taken for a photo, not for a label map."""

_GOLDEN = 0.6180339887498949  # Steps of this share of the hue circle keep any run of hues spread out.
_SATURATION = (0.85, 0.55, 0.95, 0.40, 0.75)
_VALUE = (0.95, 0.80, 0.60, 1.00, 0.42)

# Okabe and Ito's palette, which people with any colour vision tell apart, without its black.
_SAFE_COLORS = (
    (0.902, 0.624, 0.0),
    (0.337, 0.706, 0.914),
    (0.0, 0.620, 0.451),
    (0.941, 0.894, 0.259),
    (0.0, 0.447, 0.698),
    (0.835, 0.369, 0.0),
    (0.800, 0.475, 0.655),
)
_TINT = 0.45


def load_labels(path: str | os.PathLike[str], *, rgb_ids: bool = False) -> Tensor:
    """Read a label map.

    What counts as the label depends on what the file stores:

    - palette images such as DAVIS 2017: the palette index, whatever its colour;
    - grey of 1, 8 or 16 bits, and integer TIFF: the stored value, so a 0/255 mask has the labels 0 and 255;
    - RGB and RGBA: every distinct colour is a region, numbered from 0 in the order of R, then G, B and A; all
      fully transparent pixels count as one colour;
    - .npy: an integer or boolean array of two dimensions.

    Args:
        path: PNG, TIFF, GIF, BMP or .npy. Formats that change pixel values are refused.
        rgb_ids: colours are ids, R + 256 G + 65536 B, as in COCO's panoptic maps; any number of them.

    Returns:
        :math:`(H, W)` int64, non-negative; ids need not be consecutive.

    Raises:
        OSError: ``path`` does not exist, or is a folder.
        TypeError: the file holds floats.
        ValueError: the file cannot be read, is lossy or a photo (more than 4,096 colours), or holds negative values or
            another number of dimensions.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_labels(f"{folder}/map.png", torch.tensor([[0, 0, 7], [3, 3, 7]]))
        ...     load_labels(f"{folder}/map.png").tolist()
        [[0, 0, 7], [3, 3, 7]]
    """
    if Path(path).suffix.lower() == ".npy":
        try:
            # an archive becomes one object, which is no map
            values = np.asarray(np.load(path, allow_pickle=False))
        except (ValueError, EOFError) as error:
            raise ValueError(f"cannot read {path} as an .npy array: {error}") from error
        return check_labels(str(path), values, dims=(2,))
    samples = decode(path, indices=True)
    if not samples.lossless:
        raise ValueError(
            "path must be a label map in a lossless format (PNG, TIFF, GIF, BMP, .npy); "
            f"got {samples.format} at {path}, whose compression can change labels"
        )
    if samples.values.shape[-1] == 1:
        return check_labels(str(path), samples.values[..., 0], dims=(2,))
    return _from_ids(samples.values, path) if rgb_ids else _from_colors(samples.values, path)


def save_labels(path: str | os.PathLike[str], labels: Tensor, *, rgb_ids: bool = False) -> None:
    """Write a label map losslessly, whole or not at all.

    A .png is an 8-bit palette image whose index is the label if all ids are below 256, else 16-bit grey.

    Args:
        path: the file to write, .png or .npy; its folder must exist.
        labels: :math:`(H, W)` integer, non-negative; at most 65535 for .png, 2**24 - 1 with ``rgb_ids``.
        rgb_ids: write an RGB .png whose colours are ids, as `load_labels` reads them with ``rgb_ids``.

    Raises:
        FileNotFoundError: the folder of ``path`` does not exist.
        TypeError: ``labels`` is no integer tensor.
        ValueError: ``labels`` has another shape, negative ids or ids too large for the format, or the suffix
            is another.

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


def label_colors(n: int) -> Tensor:
    """Return ``n`` colours to tell regions apart by; the first of them do not depend on ``n``.

    Args:
        n: how many, at least 0.

    Returns:
        :math:`(n, 3)` float32 RGB in [0, 1].

    Raises:
        TypeError, ValueError: ``n`` is no integer of at least 0.

    Example:
        >>> tuple(label_colors(8).shape)
        (8, 3)
    """
    check_count("n", n, least=0)
    from skimage.color import hsv2rgb

    index = np.arange(n)
    cycle = index % len(_VALUE)
    colors = np.stack([index * _GOLDEN % 1, np.take(_SATURATION, cycle), np.take(_VALUE, cycle)], axis=-1)
    return torch.from_numpy(hsv2rgb(colors)).float()


def colorize_labels(labels: Tensor) -> Tensor:
    """Paint a label map: the k-th smallest id gets the k-th colour of `label_colors`.

    Args:
        labels: as `save_labels` takes them, and any ids.

    Returns:
        :math:`(3, H, W)` float32 RGB in [0, 1], on the device of ``labels``.

    Example:
        >>> image = colorize_labels(torch.tensor([[0, 255, 0]]))
        >>> tuple(image.shape), bool((image[:, 0, 0] == image[:, 0, 2]).all())
        ((3, 1, 3), True)
    """
    labels = check_labels("labels", labels, dims=(2,))
    ids, rank = torch.unique(labels, return_inverse=True)
    return label_colors(len(ids)).to(labels.device)[rank].permute(2, 0, 1).contiguous()


def overlay_labels(image: Any, labels: Tensor) -> Tensor:
    """Show a label map over its image: the image in grey, every region tinted, contours white between black.

    The seven colours of Okabe and Ito are told apart with any colour vision. Regions that touch have different
    ones, unless seven neighbours leave none.

    Args:
        image: :math:`(3, H, W)` or :math:`(1, H, W)` floating in [0, 1]; or a numpy array (H, W, C), or a PIL image.
        labels: :math:`(H, W)` integer, any non-negative ids.

    Returns:
        :math:`(3, H, W)` float32 RGB in [0, 1], on the CPU.

    Raises:
        TypeError, ValueError: as `colorize_labels`; ``image`` is no image or has another size.

    Example:
        >>> halves = (torch.arange(8) >= 4).long().expand(6, 8)
        >>> overlay_labels(torch.full((3, 6, 8), 0.5), halves)[:, 0, ::7]
        tensor([[0.6809, 0.4267],
                [0.5558, 0.5927],
                [0.2750, 0.6863]])
    """
    from skimage.color import label2rgb
    from skimage.segmentation import mark_boundaries

    image = as_image("image", image, tolerance=math.inf).detach()
    regions = check_labels("labels", labels, dims=(2,)).unique(return_inverse=True)[1].cpu()
    if image.shape[0] not in (1, 3) or image.shape[1:] != regions.shape:
        raise ValueError(
            f"image must have shape (3, H, W) or (1, H, W) with the size of labels, {tuple(regions.shape)}; got "
            f"{tuple(image.shape)}"
        )
    pixels = image.float().clamp(0, 1).expand(3, -1, -1).permute(1, 2, 0).cpu().numpy()
    colors = _neighbour_colors(regions)[regions].numpy()
    tinted = label2rgb(colors, pixels, colors=_SAFE_COLORS, alpha=_TINT, bg_label=-1)
    marked = mark_boundaries(tinted, regions.numpy(), color=(1, 1, 1), outline_color=(0, 0, 0), mode="inner")
    return torch.from_numpy(marked).permute(2, 0, 1).float().clamp(0, 1)


def _neighbour_colors(regions: Tensor) -> Tensor:
    """Return each region's colour by number: in turn, the first that none of its neighbours has."""
    earlier: dict[int, list[int]] = {}
    for low, high in touching_pairs(regions):
        earlier.setdefault(high, []).append(low)
    colors: list[int] = []
    for region in range(int(regions.max()) + 1):
        taken = {colors[other] for other in earlier.get(region, ())}
        free = [color for color in range(len(_SAFE_COLORS)) if color not in taken]
        colors.append(free[0] if free else region % len(_SAFE_COLORS))
    return torch.tensor(colors)


def _from_ids(values: Array, path: str | os.PathLike[str]) -> Tensor:
    if values.dtype != np.uint8 or values.shape[-1] != 3:
        got = f"{values.shape[-1]} channels of {values.dtype}"
        raise ValueError(f"colours that are ids must be RGB of 8 bits; got {got} in {path}")
    return torch.from_numpy(values @ np.array([1, 1 << 8, 1 << 16]))


def _from_colors(values: Array, path: str | os.PathLike[str]) -> Tensor:
    packed = np.zeros(values.shape[:2], dtype=np.uint64)
    for channel in range(values.shape[-1]):
        packed = (packed << np.uint64(16)) | values[..., channel].astype(np.uint64)
    if values.shape[-1] == 4:
        packed[values[..., 3] == 0] = 0
    colors, ids = np.unique(packed, return_inverse=True)
    if len(colors) > MAX_COLORS:
        raise ValueError(
            f"label images have at most {MAX_COLORS} distinct colours; got {len(colors)} in {path}, "
            "which looks like a photo or a mask that went through lossy compression"
        )
    return torch.from_numpy(ids.reshape(packed.shape).astype(np.int64))
