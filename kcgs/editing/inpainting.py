"""Inpainting: unknown pixels become a smooth continuation of their surroundings, or copies of other places."""

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

# most pixels of a hole, and of a hole with its surroundings: larger ones are reduced in size
_MAX_PIXELS = 2_000
_MAX_SURROUNDINGS = 40_000
# width of the surroundings from which places are copied, on each side, in extents of the hole
_SURROUNDINGS = 2
# largest distance between two parts of a hole that are filled together, in pixels
_GAP = 16
# half the side of patches that are compared, in reduced pixels
_HALF_PATCH = 3
# number of patches that are compared with all others, and their number per batch
_PATCHES = 1_500
_CHUNK = 100
# number of offsets between similar patches that are tried
_REPETITIONS = 60
# least offset between similar patches, as a share of the longer side of the hole with its surroundings
_LEAST_OFFSET = 1 / 15
# cost of a pixel that continues its surroundings smoothly; a seam costs the difference of its two sides
_SMOOTH_COST = 0.1
# cost of a pixel whose copy would come from an unknown place or from outside the image
_UNKNOWN_COST = 50.0
# weight of the difference between a copy and the smooth continuation: conspicuous things are not copied
_SMOOTH_WEIGHT = 0.02
# reduced pixels over which copies of two places are blended
_BLEND = 1
# largest difference between image and copy that is continued; if larger, an edge in only one of them tints the hole
_LARGEST_DIFFERENCE = 0.1


def inpaint(image: Tensor, unknown: Tensor) -> Tensor:
    """Continue an image (C, H, W) smoothly into its unknown pixels, (H, W) bool; at least one pixel is known.

    Source: Gortler, Grzeszczuk, Szeliski and Cohen, "The Lumigraph", 1996: pull and push.
    """
    return torch.where(unknown, _pull_push(image, (~unknown).to(image)[None]), image)


def inpaint_from_matches(image: Tensor, unknown: Tensor) -> Tensor:
    """Copy other places of the image into unknown pixels, with the least visible seams.

    The copied places are at offsets between similar patches around the hole, or beside the hole. The differences
    between image and copies around the hole are continued smoothly into it and added. Where no copy fits, pixels
    continue their surroundings smoothly, as `inpaint` does. Separate parts of the hole are filled one by one.

    Source: He and Sun, "Statistics of patch offsets for image completion", 2012.
    """
    smooth = inpaint(image, unknown)
    copy = smooth.clone()
    for window, part in _parts(unknown):
        copy[:, *window] += _copies(smooth, window, unknown[window], part) - smooth[:, *window]
    difference = (image - copy).clamp(-_LARGEST_DIFFERENCE, _LARGEST_DIFFERENCE)
    return torch.where(unknown, copy + inpaint(difference, unknown), image)


def _parts(unknown: Tensor) -> Iterator[tuple[Window, Tensor]]:
    """Yield, for each part of a hole, the window of its surroundings and the mask of the part in this window."""
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
    """Return the range of rows or columns of a hole with its surroundings."""
    low, high = int(places.min()), int(places.max()) + 1
    margin = _SURROUNDINGS * (high - low)
    return slice(max(0, low - margin), min(size, high + margin))


def _copies(image: Tensor, window: Window, unknown: Tensor, part: Tensor) -> Tensor:
    """Return a window of a smoothly continued image (C, H, W); `part` of its unknown pixels has copies."""
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
    """Return the pixel at an offset (rows, columns) from each pixel of a window; outside the image, the border."""
    rows, columns = (
        torch.arange(part.start + step, part.stop + step, device=image.device).clamp(0, size - 1)
        for part, step, size in zip(window, offset, image.shape[1:], strict=True)
    )
    return image[:, rows[:, None], columns]


def _has_source(hole: Tensor, offset: tuple[int, int]) -> Tensor:
    """Return True where the pixel at an offset is known, (H, W) bool."""
    inside = pad(~hole, (-min(offset[1], 0), max(offset[1], 0), -min(offset[0], 0), max(offset[0], 0)))
    return inside[max(offset[0], 0) :, max(offset[1], 0) :][: hole.shape[0], : hole.shape[1]]


def _offsets(image: Tensor, hole: Tensor, part: Tensor) -> list[tuple[int, int]]:
    """Return offsets (rows, columns) of places to copy: between similar patches, and the eight beside a part."""
    rows, columns = (int(places.max() - places.min()) + 1 for places in part.nonzero().T)
    beside = {(rows * down, columns * right) for down, right in product((-1, 0, 1), repeat=2)} - {(0, 0)}
    return sorted({*_repetitions(image, hole), *beside})


def _repetitions(image: Tensor, hole: Tensor) -> list[tuple[int, int]]:
    """Return the most frequent offsets (rows, columns) from patches outside a hole to their most similar patches."""
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
    """Fill pixels of a weight (1, H, W) below 1 from the image at half its size, which is filled in the same way."""
    height, width = weight.shape[1:]
    if height * width == 1:
        return image
    even = 0, width % 2, 0, height % 2
    sums, shares = (avg_pool2d(pad(t, even), 2) for t in (image * weight, weight))
    coarse = _pull_push(sums / shares.clamp_min(1e-9), (4 * shares).clamp_max(1.0))
    smooth = interpolate(coarse[None], scale_factor=2, mode="bilinear")[0, :, :height, :width]
    return smooth.lerp(image, weight)
