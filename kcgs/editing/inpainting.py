"""Unknown pixels of an image, as means of what is around them or copies of other places."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import product

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d, one_hot, pad, unfold

from .masks import dilate
from .montage import choose_layers

Window = tuple[slice, slice]

# reduced pixels of a hole, and of the hole and its surroundings, at most: larger ones are reduced
_MAX_PIXELS = 2_000
_MAX_SURROUNDINGS = 40_000
# extents of a hole from which places are copied, on each side of it
_SURROUNDINGS = 2
# pixels between two parts of a hole that are filled together
_GAP = 16
# half the side of the patches by which an image repeats itself, in reduced pixels
_HALF_PATCH = 3
# patches that are compared with all others, and of them at a time
_PATCHES = 1_500
_CHUNK = 100
# offsets by which patches repeat that are tried
_REPETITIONS = 60
# of a hole and what is around it: offsets of a smaller share of its longer side do not count as repetitions
_LEAST_OFFSET = 1 / 15
# cost of a pixel that continues its surroundings smoothly, where seams cost the difference of their sides
_SMOOTH_COST = 0.1
# cost of a pixel without a copy, as its place is unknown or beyond the image
_UNKNOWN_COST = 50.0
# weight of the difference of a copy and the smooth continuation: conspicuous things are not copied
_SMOOTH_WEIGHT = 0.02
# reduced pixels over which copies of two places are blended
_BLEND = 1
# largest difference of image and copy that is continued; with more, an edge that only one of them has tints the hole
_LARGEST_DIFFERENCE = 0.1


def inpaint(image: Tensor, unknown: Tensor) -> Tensor:
    """Continue an image (C, H, W) smoothly into its unknown pixels, (H, W) bool; one pixel at least is known.

    Source: Gortler, Grzeszczuk, Szeliski and Cohen, "The Lumigraph", 1996: pull and push.
    """
    return torch.where(unknown, _pull_push(image, (~unknown).to(image)[None]), image)


def inpaint_from_matches(image: Tensor, unknown: Tensor) -> Tensor:
    """Copy other places of the image into unknown pixels, so that seams are seen least.

    The places lie at offsets by which the image repeats itself around a hole, or beside the hole. Copies are shifted by
    a smooth continuation of the difference around them. Where no copy fits, pixels continue their surroundings
    smoothly, as `inpaint` does. Parts of the hole that are apart are filled one by one.

    Source: He and Sun, "Statistics of patch offsets for image completion", 2012.
    """
    smooth = inpaint(image, unknown)
    copy = smooth.clone()
    for window, part in _parts(unknown):
        copy[:, *window] += _copies(smooth, window, unknown[window], part) - smooth[:, *window]
    difference = (image - copy).clamp(-_LARGEST_DIFFERENCE, _LARGEST_DIFFERENCE)
    return torch.where(unknown, copy + inpaint(difference, unknown), image)


def _parts(unknown: Tensor) -> Iterator[tuple[Window, Tensor]]:
    """Yield the surroundings of each part of a hole, and which of its pixels are of the part."""
    from scipy import ndimage

    labels, count = ndimage.label(dilate(unknown, _GAP // 2).cpu().numpy())
    number = torch.from_numpy(labels).to(unknown.device)
    for label, box in enumerate(ndimage.find_objects(labels, count), start=1):
        y, x = (unknown[box] & (number[box] == label)).nonzero().T
        window = (
            _surroundings(y + box[0].start, unknown.shape[0]), _surroundings(x + box[1].start, unknown.shape[1])
        )  # fmt: skip
        yield window, unknown[window] & (number[window] == label)


def _surroundings(places: Tensor, size: int) -> slice:
    """Return the rows or columns of a hole, and those around it."""
    low, high = int(places.min()), int(places.max()) + 1
    margin = _SURROUNDINGS * (high - low)
    return slice(max(0, low - margin), min(size, high + margin))


def _copies(image: Tensor, window: Window, unknown: Tensor, part: Tensor) -> Tensor:
    """Return a window of a smoothly continued image (C, H, W), with copies in a part of its unknown pixels."""
    height, width = part.shape
    area = max(float(part.sum()) / _MAX_PIXELS, part.numel() / _MAX_SURROUNDINGS)
    reduction = max(1, round(math.sqrt(area)))
    small = avg_pool2d(image[:, *window], reduction, ceil_mode=True)
    hole, chosen = (max_pool2d(t[None].to(image), reduction, ceil_mode=True)[0] > 0 for t in (unknown, part))
    offsets = _offsets(small, hole, chosen)
    everything = slice(0, small.shape[1]), slice(0, small.shape[2])
    layers = torch.stack([small, *(_shifted(small, everything, offset) for offset in offsets)])
    costs = _SMOOTH_WEIGHT * (layers - small).norm(dim=1)
    costs[0] = _SMOOTH_COST
    for cost, offset in zip(costs[1:], offsets, strict=True):
        cost[~_has_source(hole, offset)] = _UNKNOWN_COST
    labels = choose_layers(layers, costs, chosen)
    shares = one_hot(labels, len(layers)).movedim(-1, 0).to(image)
    shares = avg_pool2d(shares, 2 * _BLEND + 1, 1, _BLEND, count_include_pad=False)
    copy = torch.zeros_like(image[:, *window])
    for share, (dy, dx) in zip(shares, [(0, 0), *offsets], strict=True):
        if share.any():
            share = interpolate(share[None, None], scale_factor=reduction, mode="bilinear")[0, 0, :height, :width]
            copy += share * _shifted(image, window, (reduction * dy, reduction * dx))
    return copy


def _shifted(image: Tensor, window: Window, offset: tuple[int, int]) -> Tensor:
    """Return what is at an offset (rows, columns) from each pixel of a window; beyond the image, its border."""
    rows, columns = (
        torch.arange(part.start + step, part.stop + step, device=image.device).clamp(0, size - 1)
        for part, step, size in zip(window, offset, image.shape[1:], strict=True)
    )
    return image[:, rows[:, None], columns]


def _has_source(hole: Tensor, offset: tuple[int, int]) -> Tensor:
    """Return which pixels have a known one at an offset, (H, W) bool."""
    inside = pad(~hole, (-min(offset[1], 0), max(offset[1], 0), -min(offset[0], 0), max(offset[0], 0)))
    return inside[max(offset[0], 0) :, max(offset[1], 0) :][: hole.shape[0], : hole.shape[1]]


def _offsets(image: Tensor, hole: Tensor, part: Tensor) -> list[tuple[int, int]]:
    """Return offsets (rows, columns) of places to copy: repetitions of the image, and the eight beside a part."""
    rows, columns = (int(places.max() - places.min()) + 1 for places in part.nonzero().T)
    beside = {(rows * down, columns * right) for down, right in product((-1, 0, 1), repeat=2)} - {(0, 0)}
    return sorted({*_repetitions(image, hole), *beside})


def _repetitions(image: Tensor, hole: Tensor) -> list[tuple[int, int]]:
    """Return the offsets (rows, columns) from most patches outside a hole to those that look most like them."""
    (height, width), side = hole.shape, 2 * _HALF_PATCH + 1
    if min(height, width) <= side:
        return []
    patches = unfold(image[None], side)[0].T
    known = (max_pool2d(hole[None].to(image), side, 1)[0].flatten() == 0).nonzero().flatten()
    if len(known) < 2:
        return []
    y, x = known // (width - side + 1), known % (width - side + 1)
    targets = patches[known]
    squares = targets.square().sum(1)
    histogram = image.new_zeros(2 * height + 1, 2 * width + 1)
    for chosen in torch.arange(0, len(known), max(1, len(known) // _PATCHES), device=known.device).split(_CHUNK):
        errors = squares - 2 * targets[chosen] @ targets.T
        dy, dx = y - y[chosen, None], x - x[chosen, None]
        errors[dy.square() + dx.square() < (_LEAST_OFFSET * max(height, width)) ** 2] = torch.inf
        best = errors.argmin(1, keepdim=True)
        dy, dx = dy.gather(1, best)[:, 0], dx.gather(1, best)[:, 0]
        for sign in (1, -1):
            histogram.index_put_((height + sign * dy, width + sign * dx), histogram.new_ones(()), accumulate=True)
    counts = avg_pool2d(histogram[None], 3, 1, 1)
    counts = torch.where(counts == max_pool2d(counts, 5, 1, 2), counts, 0)[0].flatten()
    best = counts.topk(min(_REPETITIONS, int((counts > 0).sum()))).indices
    return [(int(i) // (2 * width + 1) - height, int(i) % (2 * width + 1) - width) for i in best]


def _pull_push(image: Tensor, weight: Tensor) -> Tensor:
    """Fill where the weight (1, H, W) is below 1 from the image at half the size, filled in the same way."""
    height, width = weight.shape[1:]
    if height * width == 1:
        return image
    even = 0, width % 2, 0, height % 2
    sums, shares = (avg_pool2d(pad(t, even), 2) for t in (image * weight, weight))
    coarse = _pull_push(sums / shares.clamp_min(1e-9), (4 * shares).clamp_max(1.0))
    smooth = interpolate(coarse[None], scale_factor=2, mode="bilinear")[0, :, :height, :width]
    return smooth.lerp(image, weight)
