"""Compiled loops of contour refinement: sweeps of single pixels, energies, and small pieces."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from kcgs.compiled.program import Program, inner

program = Program("contour refinement")

# states of a pixel in the search for small pieces
_UNKNOWN = 0
_PENDING = 1
_SMALL = 2
_LARGE = 3
# weight of curvature, in units of `pair_cost`, the cost of two neighbours with different labels
_CURVATURE_COST = 1.2
# marks a pixel whose excess is not known
NOT_COUNTED = -128


class SweepState(NamedTuple):
    """The state that a sweep hands to the next sweep, for each pixel of the flat map."""

    pending: Any  # uint8, sweeps that still visit the pixel, with the present sweep; a change nearby sets it to 2
    excess: Any  # int8, pixels around it with another label minus those with its own label, or NOT_COUNTED


class CostTable(NamedTuple):
    """The cost of each pixel in each region, inside the region's box; coordinates include the map's rim."""

    values: Any  # costs of the boxes' pixels, one box after the other
    starts: Any  # [R], index of each box's first value
    boxes: Any  # [R, 4], top, bottom, left, right
    widths: Any  # [R], values per row of the box
    stride: int  # pixels per row of the map


class MapEnergy(NamedTuple):
    """The energy of a label map, which is flat and has a rim of -1."""

    labels: Any  # int32, changes
    costs: CostTable
    pair_cost: float  # of two neighbours with different labels
    disc: Any  # offsets of the pixels within two pixels, the nearest first


@inner
def _cost(costs, pixel, region):
    top, bottom, left, right = costs.boxes[region]
    y, x = pixel // costs.stride, pixel % costs.stride
    if not (top <= y < bottom and left <= x < right):
        return math.inf
    return float(costs.values[costs.starts[region] + (y - top) * costs.widths[region] + x - left])


@inner
def _has(labels, pixel, offsets, label):
    count = 0
    for offset in offsets:
        count += labels[pixel + offset] == label
    return count > 0


@inner
def _allows(limit, pixel, label):
    """True if the map of `limit` has the label in the disc around the pixel; an empty disc allows every label."""
    anchor, disc = limit
    return len(disc) == 0 or _has(anchor, pixel, disc, label)


@program.entry
def sweep_pixels(energy, limit, free, edges, neighborhood, state):
    """Give every free pixel the best label of its neighborhood; True if a pixel changed.

    `edges` are the pixels whose label differs from that of the pixel to the right or below. Candidate labels are those
    before the sweep. Pixels without a change nearby since their last visit are skipped: they would keep their labels.
    """
    labels, costs, pair_cost, disc = energy  # once: inner functions take 15 % longer with the tuple
    before, changed = labels.copy(), False
    pixels, parities = _list_near_contours(labels, free, edges, costs.stride, neighborhood)
    for parity in range(4):  # neighbours differ in parity
        for k in range(len(pixels)):
            pixel = pixels[k]
            if parities[k] != parity or state.pending[pixel] == 0:
                continue
            present = before[pixel]
            best, least = present, _curved_energy(labels, state, costs, pair_cost, disc, pixel, present)
            for place in range(1, len(neighborhood)):
                label = before[pixel + neighborhood[place]]
                if label == present or label == -1 or _has(before, pixel, neighborhood[:place], label):
                    continue
                value = _curved_energy(labels, state, costs, pair_cost, disc, pixel, label)
                if value < least and _allows(limit, pixel, label):
                    best, least = label, value
            if best != present:
                changed = True
                _change(labels, state, disc, neighborhood, pixel, best)
    for pixel in range(len(labels)):
        state.pending[pixel] -= state.pending[pixel] > 0
    return changed


@inner
def _list_near_contours(labels, free, edges, stride, neighborhood):
    """List the free pixels near both sides of a contour, and a few more, with their parities."""
    pixels, parities = np.empty(len(labels), np.int64), np.empty(len(labels), np.uint8)
    is_listed, count = np.zeros(len(labels), np.bool_), 0
    for pixel in edges:
        for other in (pixel + 1, pixel + stride):
            if labels[pixel] == labels[other] or labels[pixel] == -1 or labels[other] == -1:
                continue
            for end in (pixel, other):
                for offset in neighborhood:
                    near = end + offset
                    if free[near] and not is_listed[near]:
                        pixels[count], is_listed[near] = near, True
                        parities[count] = near // stride % 2 * 2 + near % stride % 2
                        count += 1
    return pixels[:count], parities[:count]


@inner
def _change(labels, state, disc, neighborhood, pixel, label):
    """Give a pixel a label, and update the state of the sweeps."""
    present, labels[pixel], state.excess[pixel] = labels[pixel], label, NOT_COUNTED
    for offset in neighborhood:
        state.pending[pixel + offset] = 2
    for offset in disc:
        center = pixel + offset
        around = labels[center]
        if around == -1:
            continue
        if state.excess[center] != NOT_COUNTED:
            state.excess[center] += 2 * int(around == present) - 2 * int(around == label)
        for further in disc:
            state.pending[center + further] = 2


@inner
def _energy(labels, costs, pair_cost, disc, pixel, label):
    """Return the part of the energy that depends on a pixel's label, up to a constant, without curvature."""
    equal = 0
    for offset in disc[1:9]:
        equal += labels[pixel + offset] == label
    return _cost(costs, pixel, label) - pair_cost * equal


@inner
def _curved_energy(labels, state, costs, pair_cost, disc, pixel, label):
    """Return the part of the energy that depends on a pixel's label, up to a constant."""
    present, excess, curvature = labels[pixel], 0, 0
    for offset in disc[1:]:
        center = pixel + offset
        around = labels[center]
        if around == -1:
            continue
        excess += 1 - 2 * int(around == label)
        if state.excess[center] == NOT_COUNTED:
            state.excess[center] = _count_excess(labels, disc, center)
        curvature += max(state.excess[center] + 2 * int(around == present) - 2 * int(around == label), 0) ** 2
    curvature += max(excess, 0) ** 2
    return _energy(labels, costs, pair_cost, disc, pixel, label) + _CURVATURE_COST * pair_cost * curvature


@inner
def _curvature(labels, disc, pixel):
    """Return the square of a pixel's excess; 0 for a negative excess."""
    return 0 if labels[pixel] == -1 else max(_count_excess(labels, disc, pixel), 0) ** 2


@inner
def _count_excess(labels, disc, pixel):
    """Return the excess of a pixel: the pixels around it with another label minus those with its own label."""
    excess, center = 0, labels[pixel]
    for offset in disc[1:]:
        label = labels[pixel + offset]
        excess += int(-1 != label != center) - int(label == center)
    return excess


@program.entry
def piece_energy(energy, limit, piece, label):
    """Return the energy of a piece with a label, up to a constant, without curvature; inf if it may not have it."""
    labels, costs, pair_cost, disc = energy
    total = 0.0
    for pixel in piece:
        total += _energy(labels, costs, pair_cost, disc, pixel, label) if _allows(limit, pixel, label) else math.inf
    return total


@program.entry
def map_energy_change(before, energy):
    """Return the energy of a map minus its energy with the labels `before`."""
    after, costs, pair_cost, disc = energy
    change, is_counted = 0.0, np.zeros(len(after), np.bool_)
    for pixel in range(len(after)):
        if after[pixel] == before[pixel]:
            continue
        change += _cost(costs, pixel, after[pixel]) - _cost(costs, pixel, before[pixel])
        for offset in disc:
            center = pixel + offset
            if not is_counted[center]:
                is_counted[center] = True
                curvature = _curvature(after, disc, center) - _curvature(before, disc, center)
                change += _CURVATURE_COST * pair_cost * curvature
        for offset in disc[1:9]:
            old, new = before[pixel + offset], after[pixel + offset]
            pairs = int(-1 != new != after[pixel]) - int(-1 != old != before[pixel])
            # a pair of two changed pixels is counted twice
            change += pair_cost * pairs * (1.0 if new == old else 0.5)
    return change


@program.entry
def find_small_pieces(labels, edges, stride, smallest):
    """Return the pixels of 4-connected pieces under `smallest` pixels, and for each the first pixel of its piece.

    The map is flat and has a rim of -1; `edges` are as for `sweep_pixels`. Every piece has a pixel beside another
    label. A flood fill starts at this pixel and stops when the piece is too large.
    """
    state, queue = np.zeros(len(labels), np.uint8), np.empty(smallest, np.int64)
    pixels, first, end = np.empty(64, np.int64), np.empty(64, np.int64), 0
    for pixel in edges:
        for other in (pixel + 1, pixel + stride):
            if labels[other] == labels[pixel]:
                continue
            for seed in (pixel, other):
                if labels[seed] == -1 or state[seed] != _UNKNOWN:
                    continue
                count = _fill(labels, stride, seed, state, queue)
                if end + count > len(pixels):
                    more = np.empty(len(pixels) + count, np.int64)
                    pixels, first = np.append(pixels, more), np.append(first, more)
                least = seed
                for k in range(count):  # slices and `min` would take seconds more to compile
                    pixels[end + k], least = queue[k], min(least, queue[k])
                for k in range(end, end + count):
                    first[k] = least
                end += count
    return pixels[:end], first[:end]


@inner
def _fill(labels, stride, seed, state, queue):
    """Fill the queue with the piece of a pixel; return the number of its pixels, 0 if the piece is too large."""
    queue[0], state[seed], count, k, is_large = seed, _PENDING, 1, 0, len(queue) == 1
    while k < count and not is_large:
        for step in (-stride, -1, 1, stride):
            other = queue[k] + step
            if labels[other] == labels[seed] and state[other] != _PENDING:
                is_large |= state[other] == _LARGE or count + 1 == len(queue)
                if not is_large:
                    queue[count], state[other] = other, _PENDING
                    count += 1
        k += 1
    for pixel in queue[:count]:
        state[pixel] = _LARGE if is_large else _SMALL
    return 0 if is_large else count
