"""One object, cut out by a box or a mask and clicks: GrabCut, by OpenCV."""

from __future__ import annotations

import math

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from kcgs._warn import warn_user
from kcgs.errors import InvalidArgument

from .cleanup import Prediction, merge_small
from .images import reduce_image, rgb_to_lab, to_pixels
from .prompts import Box, Point, Prompt, window_of
from .snapping import snap_contours

# Tuned by the overlap with masks of DAVIS, from boxes and from masks of ISNet: `python -m benchmarks objects`.
# width of the background around the box that GrabCut sees, in sides of the box
_MARGIN = 0.3
# largest number of pixels at which an object is segmented; more give no better masks
_MAX_PIXELS = 60_000
# steps of GrabCut from the box, and from each click
_BOX_STEPS = 5
_CLICK_STEPS = 3
# least and largest depth of a click: its distance to the nearest contour, in sides of the box
_LEAST_DEPTH = 0.03
_MOST_DEPTH = 0.15
# radius around a click of the pixels that surely have its label, in depths
_SURE_RADIUS = 0.5
# radius of the pixels that start with its label, in depths
_CHANGED_RADIUS = 1.5
# radius of the pixels that may change, in depths
_OPEN_RADIUS = 3.0
# least radius of the pixels that may change, in sides of the box
_LEAST_OPEN_RADIUS = 0.1
# half the side of the window around a click that GrabCut sees, in radii of the pixels that may change
_SEEN_RADIUS = 1.5
# smallest pieces and holes that stay, as a share of the box with its margin
_LEAST_PIECE = 0.002
# distance from a changed pixel within which the contour at full size may change, in pixels of the reduced image
_FRINGE = 2
# modes and labels of OpenCV; the lowest bit of a label is set for the object
_INIT_WITH_MASK = 1
_BACKGROUND, _OBJECT, _PERHAPS_BACKGROUND, _PERHAPS_OBJECT = 0, 1, 2, 3

NAMES = ["background", "object"]

Mask = NDArray[np.uint8]


def cut_from_box(image: Tensor, prompt: Prompt) -> Prediction:
    """Cut an object out of an image (3, H, W) in [0, 1]: its colours differ from those around a box; clicks correct it.

    Raises:
        ValueError: no object is found.

    Warns:
        UserWarning: the mask does not follow a click.
    """
    assert prompt.box is not None
    crop = _Crop(image, prompt.box)
    mask = _follow_clicks(crop, _cut_box(crop), prompt)
    labels = torch.zeros(image.shape[1:], dtype=torch.int64)
    labels[crop.window] = crop.enlarge(mask)
    return _check_object(labels, prompt)


def correct_mask(image: Tensor, mask: Tensor, prompt: Prompt) -> Prediction:
    """Correct the mask of an object, (H, W) bool, by clicks; errors and warnings are those of `cut_from_box`."""
    from scipy.ndimage import binary_dilation

    labels = mask.long()
    if prompt.clicks:
        crop = _Crop(image, prompt.box or _bounds(mask, prompt))
        before = crop.reduce(mask)
        after = _follow_clicks(crop, before, prompt)
        changed = torch.from_numpy(binary_dilation(before != after, iterations=_FRINGE))[None, None].float()
        is_near = F.interpolate(changed, crop.image.shape[1:])[0, 0] > 0
        labels[crop.window] = torch.where(is_near, crop.enlarge(after), labels[crop.window])
    return _check_object(labels, prompt)


def _bounds(mask: Tensor, prompt: Prompt) -> Box:
    """Return the bounding box of a mask and the clicks; for an empty mask, the whole image."""
    if not mask.any():
        return 0.0, 0.0, float(mask.shape[1]), float(mask.shape[0])
    y, x = (places.tolist() for places in mask.nonzero().T)
    x += [click_x for (click_x, _), _ in prompt.clicks]
    y += [click_y for (_, click_y), _ in prompt.clicks]
    return min(x), min(y), max(x) + 1.0, max(y) + 1.0


def _check_object(labels: Tensor, prompt: Prompt) -> Prediction:
    """Return labels, 0 for the background and 1 for the object; refuse an empty object; warn of clicks on the other."""
    if not labels.any():
        raise ValueError("no object is found: give a box around it, or a point of it as foreground")
    for (x, y), label in prompt.clicks:
        if labels[int(y), int(x)] != label:
            warn_user(f"the click at {x:g}, {y:g} is not in the {NAMES[label]}: colours, or another click, say no")
    return Prediction(labels, names=NAMES)


class _Crop:
    """The part of an image around a box, at its own size and reduced."""

    def __init__(self, image: Tensor, box: Box) -> None:
        height, width = image.shape[1:]
        left, top, right, bottom = box
        self.window = window_of((left - 1, top - 1, right + 1, bottom + 1), _MARGIN, height, width)
        self.image = image.cpu()[:, *self.window]
        small = reduce_image(self.image.permute(1, 2, 0).contiguous().permute(2, 0, 1), _MAX_PIXELS)
        self.pixels: NDArray[np.uint8] = np.round(to_pixels(small) * 255).astype(np.uint8)
        self.scale = small.shape[2] / self.image.shape[2], small.shape[1] / self.image.shape[1]
        left, top, right, bottom = (*self.to_crop(box[:2]), *self.to_crop(box[2:]))
        self.box = left, top, right, bottom
        self.side = math.sqrt((right - left) * (bottom - top))

    def to_crop(self, point: Point) -> Point:
        """Return a point of the image in pixels of the reduced crop."""
        rows, columns = self.window
        return (point[0] - columns.start) * self.scale[0], (point[1] - rows.start) * self.scale[1]

    def reduce(self, mask: Tensor) -> Mask:
        """Return a mask of the image, (H, W) bool, at the size of the reduced crop."""
        small = F.interpolate(mask[self.window][None, None].float(), self.pixels.shape[:2], mode="area")
        return (small[0, 0] > 0.5).numpy().astype(np.uint8)

    def enlarge(self, mask: Mask) -> Tensor:
        """Return a mask at the crop's own size, without small pieces and holes, with its contours on edges."""
        soft = torch.from_numpy(mask)[None, None].float()
        large = (F.interpolate(soft, self.image.shape[1:], mode="bilinear")[0, 0] > 0.5).numpy().astype(np.int64)
        large = merge_small(large, max(1, round(_LEAST_PIECE * large.size)))
        if large.min() != large.max():
            large = snap_contours(rgb_to_lab(self.image), large, math.ceil(1 / max(self.scale)))
        return torch.from_numpy(large)


def _cut_box(crop: _Crop) -> Mask:
    """Return the mask of the object in the box, (h, w) of 0 and 1: its colours differ from those around the box."""
    left, top, right, bottom = crop.box
    labels = np.full(crop.pixels.shape[:2], _BACKGROUND, dtype=np.uint8)
    labels[math.floor(top) : math.ceil(bottom), math.floor(left) : math.ceil(right)] = _PERHAPS_OBJECT
    if labels.all():
        raise InvalidArgument("box", "pixels of the background around it", "a box of the whole image", verb="have")
    return _run(crop.pixels, labels, _BOX_STEPS)


def _follow_clicks(crop: _Crop, mask: Mask, prompt: Prompt) -> Mask:
    """Return the mask after every click has changed the pixels around it that are connected with it."""
    clicks = [(crop.to_crop(point), label) for point, label in prompt.clicks]
    left, top, right, bottom = crop.box
    clicks = [((x, y), label) for (x, y), label in clicks if label or (left <= x < right and top <= y < bottom)]
    sure = np.full(mask.shape, _PERHAPS_OBJECT, dtype=np.uint8)
    for point, label in clicks:
        sure[_distances(mask, point) <= _SURE_RADIUS * _depth(mask, point, label, crop.side)] = label
    for point, label in clicks:
        mask = np.where(_change(crop, mask, sure, point, label), label, mask).astype(np.uint8)
    return mask


def _change(crop: _Crop, mask: Mask, sure: Mask, point: Point, label: int) -> NDArray[np.bool_]:
    """Return the mask of the pixels that a click changes to its label."""
    from scipy import ndimage

    depth = _depth(mask, point, label, crop.side)
    distances, radius = _distances(mask, point), max(_OPEN_RADIUS * depth, _LEAST_OPEN_RADIUS * crop.side)
    labels = mask + _PERHAPS_BACKGROUND
    labels[distances < _CHANGED_RADIUS * depth] = label + _PERHAPS_BACKGROUND
    labels = np.where(distances > radius, mask, labels)
    labels = np.where(sure <= _OBJECT, sure, labels)
    window = tuple(
        slice(max(0, math.floor(center - _SEEN_RADIUS * radius)), math.ceil(center + _SEEN_RADIUS * radius))
        for center in (point[1], point[0])
    )
    result = mask.copy()
    result[window] = _run(crop.pixels[window], labels[window], _CLICK_STEPS)
    is_changed: NDArray[np.bool_] = (result == label) & (mask != label)
    pieces = np.asarray(ndimage.label(is_changed | (distances <= _SURE_RADIUS * depth))[0])
    is_changed &= pieces == pieces[math.floor(point[1]), math.floor(point[0])]
    return is_changed


def _run(pixels: NDArray[np.uint8], labels: Mask, steps: int) -> Mask:
    """Run GrabCut from OpenCV's labels, (h, w), and return the mask of the object."""
    try:
        import cv2
    except ImportError as error:
        raise ImportError(
            "this method needs the package opencv-python-headless: pip install opencv-python-headless"
        ) from error
    labels = np.ascontiguousarray(labels)
    if len(np.unique(labels & 1)) == 2:  # GrabCut needs pixels of both labels
        cv2.setRNGSeed(0)  # GrabCut begins with k-means
        models = np.zeros((1, 65)), np.zeros((1, 65))
        # no rectangle: the labels replace it
        cv2.grabCut(np.ascontiguousarray(pixels), labels, (0, 0, 0, 0), models[0], models[1], steps, _INIT_WITH_MASK)
    return np.asarray(labels & 1, dtype=np.uint8)


def _distances(mask: Mask, point: Point) -> NDArray[np.float64]:
    """Return the distance of each pixel from the pixel of a point."""
    y, x = (np.arange(n) for n in mask.shape)
    return np.hypot(x - math.floor(point[0]), (y - math.floor(point[1]))[:, None])


def _depth(mask: Mask, point: Point, label: int, side: float) -> float:
    """Return the distance from a click to the nearest contour: a measure of the error's size around the click."""
    from scipy.ndimage import distance_transform_edt

    y, x = math.floor(point[1]), math.floor(point[0])
    if mask[y, x] == label:
        return _LEAST_DEPTH * side
    distance = float(distance_transform_edt(np.pad(mask != label, 1))[y + 1, x + 1])
    return min(max(distance, _LEAST_DEPTH * side), _MOST_DEPTH * side)
