"""Gaussians as whole numbers, each as fine as the image needs it (docs/format.md has the derivation and every step)."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kcgs.codec.exact import Floats, Integers, exp2, turn

from .occupancy import Grid

ENERGIES = (-24, 40)
SIZES = (-8, 28)
# octaves that a class of size spans
OCTAVES = 0.75
# quantization parameters: the distortion is D = 2^(-qp / 32)
QPS = (-512, 1023)
# half the log2 of the ratio of standard deviations
MOST_RATIO = 12.0
_MOST_LEVELS = 1 << 20
# steps that a colour may have
_MOST_COLOR = 1 << 24
_LN2 = 0.6931471805599453
# an opposition of colours: grey, red against blue, green against both; orthonormal
OPPONENT = (
    (0.5773502691896258, 0.5773502691896258, 0.5773502691896258),
    (0.7071067811865476, 0.0, -0.7071067811865476),
    (-0.408248290463863, 0.816496580927726, -0.408248290463863),
)


class Parameters(NamedTuple):
    """N Gaussians; float64 before they are rounded, float32 as a file restores them."""

    means: NDArray[Any]  # [N, 2]
    cholesky: NDArray[Any]  # [N, 3]
    colors: NDArray[Any]  # [N, C]


class Classes(NamedTuple):
    """What the steps are read from, for each Gaussian."""

    energy: Integers  # [N]
    size: Integers  # [N]


class Codes(NamedTuple):
    """N Gaussians as whole numbers."""

    energy: Integers  # [N] class
    size: Integers  # [N] class
    scale: Integers  # [N] place within the class of size
    ratio: Integers  # [N] of the standard deviations
    angle: Integers  # [N] of the longer one
    colors: Integers  # [N, C] grey first
    cell: Integers  # [N, 2] column, row
    place: Integers  # [N, 2] within the cell

    def pick(self, index: Any) -> Codes:
        """Return some of the Gaussians."""
        return Codes(*(numbers[index] for numbers in self))


class Steps(NamedTuple):
    """How fine each number of each Gaussian is."""

    size: Integers  # [N] class
    place: Floats  # [N] in standard deviations
    scales: Integers  # [N] places in a class of size
    ratio: Floats  # [N] in log2
    angle: Floats  # [N] radians, times sinh of the log ratio
    color: Floats  # [N]
    side: Integers  # [N] of the cells, in pixels, a power of two

    def turns(self, ratio: Integers) -> Integers:
        """Return how many angles there are at each ratio: one for circles."""
        log = 2.0 * ratio * self.ratio
        grown, shrunk = exp2(np.stack([log, -log]))
        stretch = 0.5 * (grown - shrunk)
        turns = np.clip(np.floor(math.pi * stretch / self.angle + 0.5), 2, _MOST_LEVELS)
        return np.where(ratio == 0, 1, turns).astype(np.int64)

    def shape(self, scale: Integers, ratio: Integers, share: Floats) -> Floats:
        """Return `cholesky` [N, 3]; `share` is the angle's code by how many there are."""
        middle = OCTAVES * (self.size + (scale + 0.5) / self.scales)
        stretch = ratio * self.ratio
        major, minor = exp2(np.stack([middle + stretch, middle - stretch]))
        cos, sin = turn(share)
        along, across = major * cos, minor * sin
        l11 = np.sqrt(along * along + across * across)
        return np.stack([l11, (major * major - minor * minor) * cos * sin / l11, major * minor / l11], -1)

    def places(self, shape: Floats) -> Integers:
        """Return how many places there are in a cell, across and down [N, 2]."""
        step = self.place[:, None] * shape[:, ::2]
        return np.clip(np.ceil(self.side[:, None] / step), 1, _MOST_LEVELS).astype(np.int64)

    def round_colors(self, colors: Floats) -> Floats:
        """Return the codes of colours [N, C]."""
        codes: Floats = np.floor(opponent(colors) / self.color[:, None] + 0.5)
        return codes

    def restore(self, codes: Codes, shape: Floats) -> Parameters:
        """Return the parameters of Gaussians whose shapes are known."""
        means = self.side[:, None] * (codes.cell + (codes.place + 0.5) / self.places(shape))
        colors = opponent(codes.colors * self.color[:, None], back=True)
        return Parameters(means.astype(np.float32), shape.astype(np.float32), colors.astype(np.float32))


class Quantizer:
    """Whole numbers from Gaussians, and back: each adds a squared error of D = 2^(-qp / 32) to the image."""

    def __init__(self, qp: int, size: tuple[int, int]) -> None:
        self.qp, self.size = qp, size
        self.distortion = float(exp2(np.array([-qp / 32.0]))[0])
        energies, sizes = (np.arange(low, high + 1, dtype=np.float64) for low, high in (ENERGIES, SIZES))
        self._relative = np.sqrt(12.0 * self.distortion / math.pi * exp2(-2.0 * energies - 1.0))  # by energy
        area = np.minimum(math.pi * exp2(2.0 * OCTAVES * (sizes + 0.5)), float(size[0] * size[1]))
        self._color = np.sqrt(12.0 * self.distortion / area)  # by size

    def classify(self, gaussians: Parameters) -> Classes:
        """Return the classes of Gaussians."""
        _, cholesky, colors = gaussians
        scale = 0.5 * np.log2(cholesky[:, 0] * cholesky[:, 2])
        within = np.minimum(scale, 0.5 * math.log2(self.size[0] * self.size[1] / math.pi))
        energy = np.log2(np.maximum(np.sqrt((colors * colors).sum(1)), 1e-12)) + within
        return Classes(
            np.clip(np.floor(energy), *ENERGIES).astype(np.int64),
            np.clip(np.floor(scale / OCTAVES), *SIZES).astype(np.int64),
        )

    def steps(self, classes: Classes) -> Steps:
        """Return the steps at which every parameter adds the distortion; cells are of all Gaussians of a class."""
        relative: Floats = self._relative[classes.energy - ENERGIES[0]]
        scale = relative * (math.sqrt(0.5) / _LN2)
        # one number for each pair of classes
        pair = (classes.energy - ENERGIES[0]) * (SIZES[1] - SIZES[0] + 1) + classes.size - SIZES[0]
        counts = np.bincount(pair)
        sides = np.zeros(len(counts), np.int64)
        for found in np.flatnonzero(counts).tolist():
            sides[found] = Grid.over(self.size, int(counts[found])).side
        return Steps(
            classes.size, place=relative * math.sqrt(2.0),
            scales=np.clip(np.floor(OCTAVES / scale + 0.5), 1, _MOST_LEVELS).astype(np.int64),
            ratio=np.maximum(relative * (1.0 / _LN2), MOST_RATIO / _MOST_LEVELS), angle=relative,
            color=self._color[classes.size - SIZES[0]], side=sides[pair],
        )  # fmt: skip

    def quantize(self, gaussians: Parameters, classes: Classes) -> Codes:
        """Round Gaussians; what leaves its class of size is brought back to its border."""
        steps = self.steps(classes)
        means, cholesky, colors = gaussians
        log_scale, log_ratio, radians = _decompose(cholesky)
        scale = np.floor((log_scale / OCTAVES - classes.size) * steps.scales).astype(np.int64)
        scale = np.clip(scale, 0, steps.scales - 1)
        ratio = np.floor(np.clip(log_ratio, 0, MOST_RATIO) / steps.ratio + 0.5).astype(np.int64)
        turns = steps.turns(ratio)
        angle = np.floor(radians / math.pi * turns + 0.5).astype(np.int64) % turns
        opposed = steps.round_colors(colors)
        if not (np.abs(opposed) < _MOST_COLOR).all():
            raise ValueError(
                f"colors must be below {_MOST_COLOR:g} steps of {steps.color.min():.3g} at this quality; got colors "
                f"up to {np.abs(colors).max():.3g}"
            )
        cell, place = self._locate(means, steps.shape(scale, ratio, angle / turns), steps)
        return Codes(*classes, scale, ratio, angle, opposed.astype(np.int64), cell, place)

    def restore(self, codes: Codes) -> Parameters:
        """Return the parameters that a decoder finds."""
        steps = self.steps(Classes(codes.energy, codes.size))
        return steps.restore(codes, steps.shape(codes.scale, codes.ratio, codes.angle / steps.turns(codes.ratio)))

    def _locate(self, means: Floats, shape: Floats, steps: Steps) -> tuple[Integers, Integers]:
        """Round x, then y to where it counts: the error of x along the Gaussian's slant is made up for."""
        parts, side = steps.places(shape), steps.side
        sides, which = np.unique(side, return_inverse=True)
        margin = np.array([Grid.of_side(self.size, one).most_margin for one in sides.tolist()], np.int64)[which]
        cells, places = [], []
        wanted = means[:, 0]
        for axis, pixels in enumerate((self.size[1], self.size[0])):
            highest = -(-pixels // side) + margin - 1
            position = np.clip(wanted / side, -margin, np.nextafter(highest + 1.0, 0))
            cell = np.floor(position).astype(np.int64)
            place = np.minimum(np.floor((position - cell) * parts[:, axis]).astype(np.int64), parts[:, axis] - 1)
            cells.append(cell)
            places.append(place)
            if axis == 0:
                rounded = side * (cell + (place + 0.5) / parts[:, 0])
                wanted = means[:, 1] + shape[:, 1] / shape[:, 0] * (rounded - means[:, 0])
        return np.stack(cells, -1), np.stack(places, -1)


def opponent(colors: Floats, *, back: bool = False) -> Floats:
    """Rotate RGB [N, 3] into grey and two oppositions, or back; other numbers of channels stay."""
    if colors.shape[1] != 3:
        return colors
    rows = tuple(zip(*OPPONENT, strict=True)) if back else OPPONENT
    # not a matrix product: its order of summation is the machine's
    return np.stack([colors[:, 0] * a + colors[:, 1] * b + colors[:, 2] * c for a, b, c in rows], -1)


def _decompose(cholesky: Floats) -> tuple[Floats, Floats, Floats]:
    """Return log2 of the mean scale, half the log2 of the ratio of scales, and the angle of the longer in [0, pi)."""
    l11, l21, l22 = cholesky.T
    product = l11 * l22
    xx, xy, yy = l11 * l11, l11 * l21, l21 * l21 + l22 * l22
    half = 0.5 * (xx - yy)
    major = 0.5 * (xx + yy) + np.hypot(half, xy)
    ratio = 0.5 * np.log2(np.maximum(major / product, 1.0))
    return 0.5 * np.log2(product), ratio, 0.5 * np.arctan2(xy, half) % math.pi
