"""One object from a box and clicks: GrabCut, by OpenCV."""

import math

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from kcgs._warn import warn_user
from kcgs.errors import InvalidArgument
from kcgs.segment.cleanup import Cleanup, Prediction, merge_small
from kcgs.segment.images import reduce_image, rgb_to_lab, to_pixels
from kcgs.segment.prompts import Points, Prompt, check_prompt
from kcgs.segment.registry import register
from kcgs.segment.snapping import snap_contours

# around the box, what GrabCut sees of the background, in sides of the box
_MARGIN = 0.3
# pixels at which an object is segmented, at most; more give no better masks
_MAX_PIXELS = 60_000
# steps from the box, and from each click
_BOX_STEPS = 5
_CLICK_STEPS = 3
# least depth of a click in what it corrects, in sides of the box
_LEAST_DEPTH = 0.03
# radius around a click of what surely has its label, in depths
_SURE = 0.5
# radius of what has its label to begin with, in depths
_CHANGED = 1.5
# radius of what may change, in depths
_OPEN = 4.0
# least radius of what may change, in sides of the box
_LEAST_OPEN = 0.5
# radius of what GrabCut sees around a click, in radii of what may change
_SEEN = 1.5
# pieces and holes of a smaller share of the box and its margin vanish
_LEAST_PIECE = 0.002
# modes and labels of OpenCV; the lowest bit of a label is set for the object
_INIT_WITH_MASK = 1
_BACKGROUND, _OBJECT, _PERHAPS_BACKGROUND, _PERHAPS_OBJECT = 0, 1, 2, 3

Mask = NDArray[np.uint8]


@register("grabcut", Cleanup(min_size=1, connected=False))
def grabcut(
    image: Tensor, *, box: Points, foreground: Points | None = None, background: Points | None = None
) -> Prediction:
    """Segment one object, by a box around it and clicks, with GrabCut (Rother, Kolmogorov and Blake, SIGGRAPH 2004).

    Colours outside of the box are the background's. The object is cut out of a reduced image. Each click then changes
    what lies around it, within a distance that grows with the distance to the nearest contour: click into the middle of
    what is wrong, first where most is. Contours snap to edges at full size. The names of regions are "object" and
    "background"; the object is in one region, though it may have several pieces. The result is the same every time.

    Args:
        image: as `segment` takes it, any size.
        box: left, top, right, bottom in pixels, somewhat larger than the object.
        foreground: :math:`(P, 2)` points (x, y) of the object, in pixels, in the box.
        background: :math:`(P, 2)` points (x, y) that are not of it.

    Raises:
        TypeError, ValueError: a box without pixels of the image or without any around it; points outside of the image,
            or of the object and outside of the box.
        ImportError: OpenCV is not installed.

    Warns:
        UserWarning: a click that the mask does not follow.

    Example:
        ``segment(image, "grabcut", box=(30, 40, 200, 180), background=[(60, 70)])``
    """
    prompt = check_prompt(image, box, foreground, background)
    assert prompt.box is not None
    height, width = image.shape[1:]
    left, top, right, bottom = prompt.box
    if (left, top, right, bottom) == (0, 0, width, height):
        raise InvalidArgument("box", "pixels of the background around it", "a box of the whole image", verb="have")
    for x, y in prompt.foreground:
        if not (left <= x <= right and top <= y <= bottom):
            raise InvalidArgument("foreground", "in the box", (x, y))
    columns, rows = _window(left, right, width), _window(top, bottom, height)
    crop = image.cpu()[:, rows, columns]
    small = reduce_image(crop.permute(1, 2, 0).contiguous().permute(2, 0, 1), _MAX_PIXELS)
    scale = small.shape[2] / crop.shape[2], small.shape[1] / crop.shape[1]
    mask = _cut(small, _scale_prompt(prompt, (columns.start, rows.start), scale))
    labels = torch.zeros(height, width, dtype=torch.int64)
    labels[rows, columns] = torch.from_numpy(_enlarge(crop, mask, max(scale)))
    for points, region, whole in ((prompt.foreground, 1, "object"), (prompt.background, 0, "background")):
        for x, y in points:
            if labels[min(int(y), height - 1), min(int(x), width - 1)] != region:
                warn_user(f"the click at {x:g}, {y:g} is not in the {whole}: colours, or another click, say no")
    return Prediction(labels, names=["background", "object"])


def _window(low: float, high: float, size: int) -> slice:
    """Return the pixels of one axis that matter: those of the box, with a margin."""
    margin = _MARGIN * (high - low) + 1
    return slice(max(0, math.floor(low - margin)), min(size, math.ceil(high + margin)))


def _scale_prompt(prompt: Prompt, origin: tuple[int, int], scale: tuple[float, float]) -> Prompt:
    """Return a prompt in pixels of the reduced crop."""
    assert prompt.box is not None
    x0, y0, x1, y1 = ((value - origin[k % 2]) * scale[k % 2] for k, value in enumerate(prompt.box))
    foreground, background = (
        [((x - origin[0]) * scale[0], (y - origin[1]) * scale[1]) for x, y in points]
        for points in (prompt.foreground, prompt.background)
    )
    return Prompt((x0, y0, x1, y1), foreground, background)


def _cut(image: Tensor, prompt: Prompt) -> Mask:
    """Return where the object is, (H, W) of 0 and 1."""
    assert prompt.box is not None
    left, top, right, bottom = prompt.box
    pixels = np.round(to_pixels(image) * 255).astype(np.uint8)
    sure = np.full(pixels.shape[:2], _BACKGROUND, dtype=np.uint8)
    sure[math.floor(top) : math.ceil(bottom), math.floor(left) : math.ceil(right)] = _PERHAPS_OBJECT
    mask = _run(pixels, sure, _BOX_STEPS)
    side = math.sqrt((right - left) * (bottom - top))
    clicks = [(point, _OBJECT) for point in prompt.foreground]
    inside = [(x, y) for x, y in prompt.background if left <= x < right and top <= y < bottom]  # others change nothing
    clicks += [(point, _BACKGROUND) for point in inside]
    for point, label in clicks:
        sure[_distances(pixels, point) <= _SURE * _depth(mask, point, label, side)] = label
    for point, label in clicks:
        depth = _depth(mask, point, label, side)
        distances, radius = _distances(pixels, point), max(_OPEN * depth, _LEAST_OPEN * side)
        labels = mask + _PERHAPS_BACKGROUND
        labels[distances < _CHANGED * depth] = label + _PERHAPS_BACKGROUND
        labels = np.where(distances > radius, mask, labels)
        labels = np.where(sure <= _OBJECT, sure, labels)
        rows, columns = (
            slice(max(0, math.floor(center - _SEEN * radius)), math.ceil(center + _SEEN * radius))
            for center in (point[1], point[0])
        )
        mask[rows, columns] = _run(pixels[rows, columns], labels[rows, columns], _CLICK_STEPS)
    return mask


def _run(pixels: NDArray[np.uint8], labels: Mask, steps: int) -> Mask:
    """Run GrabCut from labels of OpenCV, (H, W), and return where the object is."""
    try:
        import cv2
    except ImportError as error:
        raise ImportError(
            "this method needs the package opencv-python-headless: pip install 'kcgs[grabcut]'"
        ) from error
    labels = np.ascontiguousarray(labels)
    if len(np.unique(labels & 1)) == 2:  # else there is nothing to tell apart
        cv2.setRNGSeed(0)  # of the k-means that it begins with
        models = np.zeros((1, 65)), np.zeros((1, 65))
        # no rectangle, for the labels say what it would
        cv2.grabCut(np.ascontiguousarray(pixels), labels, (0, 0, 0, 0), models[0], models[1], steps, _INIT_WITH_MASK)
    return np.asarray(labels & 1, dtype=np.uint8)


def _distances(pixels: NDArray[np.uint8], point: tuple[float, float]) -> NDArray[np.float64]:
    """Return the distance of each pixel from that of a point."""
    y, x = (np.arange(n) for n in pixels.shape[:2])
    return np.hypot(x - math.floor(point[0]), (y - math.floor(point[1]))[:, None])


def _depth(mask: Mask, point: tuple[float, float], label: int, side: float) -> float:
    """Return the distance from a click to the nearest contour, which tells how much is wrong around it."""
    from scipy.ndimage import distance_transform_edt

    y, x = math.floor(point[1]), math.floor(point[0])
    if mask[y, x] == label:
        return _LEAST_DEPTH * side
    return max(float(distance_transform_edt(np.pad(mask != label, 1))[y + 1, x + 1]), _LEAST_DEPTH * side)


def _enlarge(image: Tensor, mask: Mask, scale: float) -> NDArray[np.int64]:
    """Return a mask at the size of (3, H, W), without small pieces and holes, with its contours on edges."""
    soft = torch.from_numpy(mask)[None, None].float()
    large = (F.interpolate(soft, image.shape[1:], mode="bilinear")[0, 0] > 0.5).numpy().astype(np.int64)
    large = merge_small(large, max(1, round(_LEAST_PIECE * large.size)))
    if large.min() == large.max():
        return large
    return snap_contours(rgb_to_lab(image), large, math.ceil(1 / scale))
