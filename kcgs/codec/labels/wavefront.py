"""The pass over a label map, wavefront by wavefront: find the coded pixels, estimate chances, learn from the bits.

A wavefront has the pixels of equal x + 8 y; the chances of its bits depend only on earlier wavefronts (docs/format.md).
A row continues with its last label until a decision changes it, so that only pixels near contours cost time.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from kcgs.compiled.program import Program, inner

from .contexts import (
    LEFT,
    PIXEL,
    RIGHT,
    TOP,
    file_network,
    find_counters,
    find_features,
    is_quiet,
    learn,
    load_prior,
    mix,
    new_counters,
    new_mixer,
    scene_network,
)

SLANT = 8  # pixels (x, y) of equal x + SLANT * y make a wavefront
MAX_NEAREST = 3  # nearest labels that an explicit label is compared with
_MAX_RADIUS = 32  # radius of the search for nearest labels, in pixels
_AHEAD = 128  # pixels of a row that are written ahead; if all were, each change would cost a whole row

STATE = np.dtype(
    [
        ("front", np.int64),  # the current wavefront, x + SLANT * y
        ("num_pixels", np.int64),  # seeds and coded pixels of the wavefront
        ("num_coded", np.int64),  # pixels of the wavefront that bits decide
        ("num_regions", np.int64),  # regions of the map
        ("is_file", np.int64),  # 1: the network for files of maps; 0: the network for scenes
    ]
)
_LINE = np.dtype(
    [
        ("change", np.int32),  # column of the last pixel whose label differs from that of its left neighbour
        ("seed", np.int32),  # column of the next seed
        ("wake", np.int32),  # all pixels are quiet until this wavefront
        ("end", np.int32),  # the last label is written up to this column
    ]
)


class Scan(NamedTuple):
    """The arrays that a pass over a map of height H and width W reads and writes."""

    state: Any  # STATE
    labels: Any  # [TOP + H + 1, LEFT + W + RIGHT] the labels so far, and margins
    seeds: Any  # [H, W] uint8, 1 where a pixel is a seed
    lines: Any  # [TOP + H + 2] _LINE, of each row of the labels
    pixels: Any  # [H] PIXEL, of the current wavefront
    units: Any  # the network's hidden units
    counters: Any  # the counters of the context model
    mixer: Any  # the weights of its mixer
    chances: Any  # [2 H] float64, of the wavefront's bits
    answers: Any  # [2 H] int32, the bits, where the map is known


def new_scan(seeds: Any, num_regions: int, *, is_file: bool) -> Scan:
    """Return the start of a pass over a map with these seeds."""
    height, width = seeds.shape
    prior = load_prior("map_file_prior.bin" if is_file else "scene_prior.bin")
    state = np.zeros(1, STATE)[0]
    state["num_regions"], state["is_file"] = num_regions, is_file
    return Scan(
        state,
        np.zeros((height + TOP + 1, width + LEFT + RIGHT), np.int32),
        seeds,
        np.zeros(TOP + height + 2, _LINE),
        np.zeros(height, PIXEL),
        np.zeros(sum(prior[2].shape), np.int32),
        new_counters(),
        new_mixer(prior),
        np.zeros(2 * height),
        np.zeros(2 * height, np.int32),
    )


program = Program("label coder")


@program.entry
def advance(scan, bits, truth):
    """Label the current wavefront by its bits; go to the next one with seeds or coded pixels; return their number.

    `truth` has the number of each pixel's region; it is empty for a decoder.
    """
    height, width = scan.seeds.shape
    state = scan.state
    _label_pixels(scan, bits)
    state.num_pixels = 0
    state.num_coded = 0
    while state.num_pixels == 0 and state.front < width - 1 + SLANT * (height - 1):
        state.front += 1
        _find_pixels(scan)
    _estimate(scan, truth)
    return state.num_pixels


@inner
def _label_pixels(scan, bits):
    """Give the wavefront's pixels their labels and learn from them."""
    labels, lines, state = scan.labels, scan.lines, scan.state
    num_neither_bits = state.num_coded if state.num_regions > 2 else 0
    bit = 0
    for n in range(state.num_pixels):
        pixel = scan.pixels[n]
        if pixel.is_coded:
            is_neither = False
            if num_neither_bits > 0:
                is_neither = bits[bit] != 0
                learn(scan.counters, scan.mixer, pixel, 1, bits[bit])
            if not is_neither:
                is_second = bits[num_neither_bits + bit]
                learn(scan.counters, scan.mixer, pixel, 0, is_second)
                pixel.label = pixel.second if is_second else pixel.first
            bit += 1
        y, x, label = pixel.y, pixel.x, pixel.label
        if label != labels[y, x - 1]:
            lines[y].change = x
            for below in range(y, y + 3):
                lines[below].wake = 0  # these rows see the change
            _continue(labels, lines, y, x, label)
        _fill_margins(labels, y, x, label)


@inner
def _find_pixels(scan):
    """List the seeds and coded pixels of a wavefront; its other pixels continue the label of their row."""
    labels, seeds, lines, state = scan.labels, scan.seeds, scan.lines, scan.state
    height, width = seeds.shape
    front = state.front
    for j in range(max(0, -((width - 1 - front) // SLANT)), min(height - 1, front // SLANT) + 1):
        x, y = front - SLANT * j + LEFT, j + TOP
        line = lines[y]
        if x + RIGHT >= line.end:
            _continue(labels, lines, y, x, labels[y, x - 1])
        if line.wake > front:
            continue
        seed = max(line.seed, x)
        while seed < width + LEFT and seeds[j, seed - LEFT] == 0:
            seed += 1
        line.seed = seed
        quiet = _is_still_quiet(labels, lines, y, x)
        if quiet and x != seed:
            _fill_margins(labels, y, x, labels[y, x - 1])
            if y >= TOP + 2 and lines[y - 2].change < x:
                line.wake = front + seed - x
            continue
        pixel = scan.pixels[state.num_pixels]
        pixel.x = x
        pixel.y = y
        pixel.is_coded = not quiet
        state.num_pixels += 1
        if quiet:
            pixel.first = labels[y, x - 1]
            pixel.second = -1
            pixel.label = 1 - pixel.first  # the other of two regions; its explicit label replaces it if there are more
        else:
            find_features(labels, pixel)
            state.num_coded += 1


@inner
def _is_still_quiet(labels, lines, y, x):
    """Return the value of `is_quiet`, faster: in most cases the last change in each row decides it."""
    if y < TOP + 2:
        return is_quiet(labels, y, x)
    label = labels[y, x - 1]
    if lines[y].change > x - 2 or lines[y - 1].change > x - 2:
        return False
    if labels[y - 1, x] != label or labels[y - 2, x] != label:
        return False
    return lines[y - 2].change < x or is_quiet(labels, y, x)


@inner
def _continue(labels, lines, y, x, label):
    """Write a label at a pixel and ahead of it."""
    labels[y, x : x + _AHEAD] = label
    lines[y].end = x + _AHEAD


@inner
def _fill_margins(labels, y, x, label):
    """Repeat the label of a pixel in the margins above and left of the map."""
    if y == TOP:
        labels[:TOP, x : x + RIGHT + 1] = label
    if x == LEFT:
        labels[y + 1, :LEFT] = label


@inner
def _estimate(scan, truth):
    """Fill in chances, and answers if the truth is known: first of "neither candidate", then of "the second"."""
    state, chances, answers = scan.state, scan.chances, scan.answers
    num_neither_bits = state.num_coded if state.num_regions > 2 else 0
    bit = 0
    for n in range(state.num_pixels):
        pixel = scan.pixels[n]
        if len(truth) > 0:
            pixel.label = truth[pixel.y - TOP, pixel.x - LEFT]
        if pixel.is_coded:
            if state.is_file:
                file_network(pixel, scan.units)
            else:
                scene_network(pixel, scan.units)
            find_counters(pixel)
            if num_neither_bits > 0:
                chances[bit] = mix(scan.counters, scan.mixer, pixel, 1)
                answers[bit] = pixel.label != pixel.first and pixel.label != pixel.second
            chances[num_neither_bits + bit] = mix(scan.counters, scan.mixer, pixel, 0)
            answers[num_neither_bits + bit] = pixel.label != pixel.first
            bit += 1


@program.entry
def find_nearest(labels, pixel, nearest):
    """Fill in the MAX_NEAREST labels nearest to a pixel, except its candidates; return how many were found."""
    count = 0
    for radius in range(1, _MAX_RADIUS + 1):
        for j in range(-radius, 1):
            step = 1 if j == -radius else 2 * radius
            for i in range(-radius, radius + 1, step):
                y, x = pixel.y + j, pixel.x + i
                if i + SLANT * j >= 0 or y < 0 or x < 0 or x >= labels.shape[1]:
                    continue
                label = labels[y, x]
                is_known = label == pixel.first or label == pixel.second
                for k in range(count):
                    is_known |= nearest[k] == label
                if not is_known:
                    nearest[count] = label
                    count += 1
                    if count == MAX_NEAREST:
                        return count
    return count


@program.entry
def order_regions(index, num_regions):
    """Number the regions in the order in which wavefronts reach them, and mark seeds.

    Returns the number of each pixel's region, the seeds, and for each number the region's value in `index`.
    """
    height, width = index.shape
    number = np.full(num_regions, -1, np.int32)
    order = np.empty(num_regions, np.int32)
    count = 0
    for front in range(width + SLANT * (height - 1)):
        for j in range(max(0, -((width - 1 - front) // SLANT)), min(height - 1, front // SLANT) + 1):
            position = index[j, front - SLANT * j]
            if number[position] < 0:
                number[position] = count
                order[count] = position
                count += 1
        if count == num_regions:
            break
    truth = np.empty(index.shape, np.int32)
    seeds = np.zeros(index.shape, np.uint8)
    labels = np.zeros((height + TOP + 1, width + LEFT + RIGHT), np.int32)
    for j in range(height):
        for i in range(width):
            x, y = i + LEFT, j + TOP
            truth[j, i] = number[index[j, i]]
            seeds[j, i] = truth[j, i] != labels[y, x - 1] and is_quiet(labels, y, x)
            labels[y, x] = truth[j, i]
            _fill_margins(labels, y, x, truth[j, i])
        labels[y, LEFT + width :] = truth[j, width - 1]
    return truth, seeds, order
