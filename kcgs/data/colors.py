"""Label maps as colour images."""

import math
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from kcgs._check import check_count
from kcgs._image import as_image
from kcgs._labels import check_labels
from kcgs.errors import InvalidArgument
from kcgs.maps import interior_points, touching_pairs

# step of the hue, the golden ratio minus 1: consecutive hues are spread over the circle
_HUE_STEP = 0.6180339887498949
# cycles of saturation and value: colours with similar hues differ in these
_SATURATIONS = (0.85, 0.55, 0.95, 0.40, 0.75)
_VALUES = (0.95, 0.80, 0.60, 1.00, 0.42)

# the palette of Okabe and Ito without black: people with any colour vision can tell its colours apart
_SAFE_COLORS = (
    (0.902, 0.624, 0.0),
    (0.337, 0.706, 0.914),
    (0.0, 0.620, 0.451),
    (0.941, 0.894, 0.259),
    (0.0, 0.447, 0.698),
    (0.835, 0.369, 0.0),
    (0.800, 0.475, 0.655),
)
# share of the colour of a region in an overlay
_TINT = 0.45
# height of an id in an overlay, as a multiple of the distance from its place to the contour
_TEXT_SHARE = 1.6
# least and largest height of an id, in pixels; smaller ids cannot be read and are left out
_MIN_TEXT = 7.0
_MAX_TEXT = 24.0


def label_colors(n: int) -> Tensor:
    """Return ``n`` distinct colours; the first colours do not depend on ``n``.

    Args:
        n: number of colours, at least 0.

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
    cycle = index % len(_VALUES)
    colors = np.stack([index * _HUE_STEP % 1, np.take(_SATURATIONS, cycle), np.take(_VALUES, cycle)], axis=-1)
    return torch.from_numpy(hsv2rgb(colors)).float()


def colorize_labels(labels: Tensor) -> Tensor:
    """Return a label map in colours: the k-th smallest id has the k-th colour of `label_colors`.

    Args:
        labels: :math:`(H, W)` integer, any non-negative ids.

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


def overlay_labels(image: Any, labels: Tensor, *, ids: bool = False) -> Tensor:
    """Return a label map over its image: the image in grey, tinted regions, white contours with black outlines.

    The tints are the seven colours of Okabe and Ito, which differ for any colour vision. Touching regions differ in
    colour, unless the neighbours of a region use all seven.

    Args:
        image: :math:`(3, H, W)` or :math:`(1, H, W)` floating in [0, 1]; or a numpy array (H, W, C), or a PIL image.
        labels: :math:`(H, W)` integer, any non-negative ids.
        ids: write the id of each region into the region, if there is room.

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
    names, regions = (t.cpu() for t in check_labels("labels", labels, dims=(2,)).unique(return_inverse=True))
    if image.shape[0] not in (1, 3) or image.shape[1:] != regions.shape:
        raise InvalidArgument(
            "image",
            f"shape (3, H, W) or (1, H, W) with the size of labels, {tuple(regions.shape)}",
            tuple(image.shape),
            verb="have",
        )
    pixels = image.float().clamp(0, 1).expand(3, -1, -1).permute(1, 2, 0).cpu().numpy()
    colors = _neighbour_colors(regions)[regions].numpy()
    tinted = label2rgb(colors, pixels, colors=_SAFE_COLORS, alpha=_TINT, bg_label=-1)
    marked = mark_boundaries(tinted, regions.numpy(), color=(1, 1, 1), outline_color=(0, 0, 0), mode="inner")
    overlay = torch.from_numpy(marked).permute(2, 0, 1).float().clamp(0, 1)
    return _write_ids(overlay, regions, names.tolist()) if ids else overlay


def _neighbour_colors(regions: Tensor) -> Tensor:
    """Return the index of a colour for each region: the first colour that no earlier neighbour has."""
    earlier: dict[int, list[int]] = {}
    for low, high in touching_pairs(regions):
        earlier.setdefault(high, []).append(low)
    colors: list[int] = []
    for region in range(int(regions.max()) + 1):
        neighbours = {colors[other] for other in earlier.get(region, ())}
        free = (color for color in range(len(_SAFE_COLORS)) if color not in neighbours)
        colors.append(next(free, region % len(_SAFE_COLORS)))
    return torch.tensor(colors)


def _write_ids(image: Tensor, regions: Tensor, names: list[int]) -> Tensor:
    """Write the id of each region, white with a black outline, where the region is widest."""
    canvas = Image.fromarray((image * 255).round().byte().permute(1, 2, 0).numpy())
    writer = ImageDraw.Draw(canvas)
    points, distances = interior_points(regions)
    for name, point, distance in zip(names, points.tolist(), distances.tolist(), strict=True):
        size = min(_MAX_TEXT, _TEXT_SHARE * distance / max(1.0, len(str(name)) / 2))
        if size >= _MIN_TEXT:
            font = ImageFont.load_default(size)
            writer.text(point, str(name), "white", font, "mm", stroke_width=max(1, size / 10), stroke_fill="black")
    return torch.from_numpy(np.asarray(canvas).copy()).permute(2, 0, 1).float() / 255
