"""Gaussians as whole numbers, each as precise as the image needs it (docs/format.md derives every step)."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kcgs.codec.exact import LN2, Floats, Integers, cos_sin, exp2
from kcgs.errors import InvalidArgument

from .occupancy import Grid

ENERGIES = (-24, 40)  # least and largest class of energy: log2 of the amplitude times the mean standard deviation
SIZES = (-8, 28)  # least and largest class of size
OCTAVES = 0.75  # octaves of the mean standard deviation that a class of size spans
QPS = (-512, 1023)  # least and largest quantization parameter
QP_PER_OCTAVE = 32  # quantization parameters per octave of the distortion, D = 2^(-qp / 32)
MAX_RATIO = 12.0  # largest ratio of standard deviations, in half the log2 of it
_MAX_STEPS = 1 << 20  # most steps of a scale, a ratio, an angle or a place
_MAX_COLOR = 1 << 24  # steps that a colour stays below
_MIN_AMPLITUDE = 1e-12  # least amplitude of a colour, since log2 of 0 is not finite
# rows: grey, red against blue, green against both; orthonormal
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
    """The two classes of each Gaussian; they determine its steps."""

    energy: Integers  # [N]
    size: Integers  # [N]


class Codes(NamedTuple):
    """N Gaussians as whole numbers."""

    energy: Integers  # [N] class of energy
    size: Integers  # [N] class of size
    scale: Integers  # [N] scale within the class of size
    ratio: Integers  # [N] ratio of the standard deviations
    angle: Integers  # [N] angle of the longer axis
    colors: Integers  # [N, C] colour, grey first
    cell: Integers  # [N, 2] column and row of the cell
    place: Integers  # [N, 2] place within the cell: across, down

    def select(self, index: Any) -> Codes:
        """Return the Gaussians of an index."""
        return Codes(*(numbers[index] for numbers in self))


class StepSizes(NamedTuple):
    """The steps of each Gaussian's parameters."""

    size: Integers  # [N] class of size
    place: Floats  # [N] step of a place, in standard deviations
    num_scales: Integers  # [N] number of scales in a class of size
    ratio: Floats  # [N] step of a ratio, in log2
    angle: Floats  # [N] step of an angle in radians, times sinh of the log ratio
    color: Floats  # [N] step of a colour
    side: Integers  # [N] side of the cells, in pixels, a power of two

    def num_angles(self, ratio: Integers) -> Integers:
        """Return the number of angles at each ratio: one for circles."""
        log = 2.0 * ratio * self.ratio
        larger, smaller = exp2(np.stack([log, -log]))
        sinh = 0.5 * (larger - smaller)
        count = np.clip(np.floor(math.pi * sinh / self.angle + 0.5), 2, _MAX_STEPS)
        return np.where(ratio == 0, 1, count).astype(np.int64)

    def shape(self, scale: Integers, ratio: Integers, share: Floats) -> Floats:
        """Return `cholesky` [N, 3]; `share` is the angle in half turns."""
        middle = OCTAVES * (self.size + (scale + 0.5) / self.num_scales)
        log_ratio = ratio * self.ratio
        major, minor = exp2(np.stack([middle + log_ratio, middle - log_ratio]))
        cos, sin = cos_sin(share)
        along, across = major * cos, minor * sin
        l11 = np.sqrt(along * along + across * across)
        return np.stack([l11, (major * major - minor * minor) * cos * sin / l11, major * minor / l11], -1)

    def num_places(self, shape: Floats) -> Integers:
        """Return the number of places in a cell, across and down [N, 2]."""
        step = self.place[:, None] * shape[:, ::2]
        return np.clip(np.ceil(self.side[:, None] / step), 1, _MAX_STEPS).astype(np.int64)

    def round_colors(self, colors: Floats) -> Floats:
        """Return the codes of colours [N, C]."""
        codes: Floats = np.floor(opponent(colors) / self.color[:, None] + 0.5)
        return codes

    def dequantize(self, codes: Codes, shape: Floats) -> Parameters:
        """Return the parameters of Gaussians whose shapes are known."""
        means = self.side[:, None] * (codes.cell + (codes.place + 0.5) / self.num_places(shape))
        colors = opponent(codes.colors * self.color[:, None], inverse=True)
        return Parameters(means.astype(np.float32), shape.astype(np.float32), colors.astype(np.float32))


class Quantizer:
    """Turn Gaussians into whole numbers and back; each number adds a squared error of D = 2^(-qp / 32) to the image."""

    def __init__(self, qp: int, size: tuple[int, int]) -> None:
        self.qp, self.size = qp, size
        self.distortion = float(exp2(np.array([-qp / QP_PER_OCTAVE]))[0])
        energies, sizes = (np.arange(low, high + 1, dtype=np.float64) for low, high in (ENERGIES, SIZES))
        self._energy_steps = np.sqrt(12.0 * self.distortion / math.pi * exp2(-2.0 * energies - 1.0))  # by energy
        area = np.minimum(math.pi * exp2(2.0 * OCTAVES * (sizes + 0.5)), float(size[0] * size[1]))
        self._color_steps = np.sqrt(12.0 * self.distortion / area)  # by size

    def classify(self, gaussians: Parameters) -> Classes:
        """Return the classes of Gaussians."""
        _, cholesky, colors = gaussians
        scale = 0.5 * np.log2(cholesky[:, 0] * cholesky[:, 2])
        visible_scale = np.minimum(scale, 0.5 * math.log2(self.size[0] * self.size[1] / math.pi))
        energy = np.log2(np.maximum(np.sqrt((colors * colors).sum(1)), _MIN_AMPLITUDE)) + visible_scale
        return Classes(
            np.clip(np.floor(energy), *ENERGIES).astype(np.int64),
            np.clip(np.floor(scale / OCTAVES), *SIZES).astype(np.int64),
        )

    def steps(self, classes: Classes) -> StepSizes:
        """Return the steps at which every parameter adds the distortion; all Gaussians of a class share a grid."""
        relative: Floats = self._energy_steps[classes.energy - ENERGIES[0]]
        log_scale = relative * (math.sqrt(0.5) / LN2)
        pair = (classes.energy - ENERGIES[0]) * (SIZES[1] - SIZES[0] + 1) + classes.size - SIZES[0]
        counts = np.bincount(pair)
        sides = np.zeros(len(counts), np.int64)
        for index in np.flatnonzero(counts).tolist():
            sides[index] = Grid.for_count(self.size, int(counts[index])).side
        return StepSizes(
            classes.size,
            place=relative * math.sqrt(2.0),
            num_scales=np.clip(np.floor(OCTAVES / log_scale + 0.5), 1, _MAX_STEPS).astype(np.int64),
            ratio=np.maximum(relative * (1.0 / LN2), MAX_RATIO / _MAX_STEPS),
            angle=relative,
            color=self._color_steps[classes.size - SIZES[0]],
            side=sides[pair],
        )

    def quantize(self, gaussians: Parameters, classes: Classes) -> Codes:
        """Round Gaussians; a scale outside its class of size moves to the border of the class."""
        steps = self.steps(classes)
        means, cholesky, colors = gaussians
        log_scale, log_ratio, radians = _decompose(cholesky)
        scale = np.floor((log_scale / OCTAVES - classes.size) * steps.num_scales).astype(np.int64)
        scale = np.clip(scale, 0, steps.num_scales - 1)
        ratio = np.floor(np.clip(log_ratio, 0, MAX_RATIO) / steps.ratio + 0.5).astype(np.int64)
        num_angles = steps.num_angles(ratio)
        angle = np.floor(radians / math.pi * num_angles + 0.5).astype(np.int64) % num_angles
        color_codes = steps.round_colors(colors)
        if not (np.abs(color_codes) < _MAX_COLOR).all():
            raise InvalidArgument(
                "colors",
                f"below {_MAX_COLOR:g} steps of {steps.color.min():.3g} at this quality",
                f"colors up to {np.abs(colors).max():.3g}",
            )
        cell, place = self._locate(means, steps.shape(scale, ratio, angle / num_angles), steps)
        return Codes(*classes, scale, ratio, angle, color_codes.astype(np.int64), cell, place)

    def dequantize(self, codes: Codes) -> Parameters:
        """Return the parameters that a decoder restores."""
        steps = self.steps(Classes(codes.energy, codes.size))
        share = codes.angle / steps.num_angles(codes.ratio)
        return steps.dequantize(codes, steps.shape(codes.scale, codes.ratio, share))

    def _locate(self, means: Floats, shape: Floats, steps: StepSizes) -> tuple[Integers, Integers]:
        """Round x, then y; y makes up for the error of x along the slant of the Gaussian."""
        num_places, side = steps.num_places(shape), steps.side
        sides, index = np.unique(side, return_inverse=True)
        margin = np.array([Grid.of_side(self.size, one).max_margin for one in sides.tolist()], np.int64)[index]
        cells, places = [], []
        target = means[:, 0]
        for axis, pixels in enumerate((self.size[1], self.size[0])):
            last = -(-pixels // side) + margin - 1
            position = np.clip(target / side, -margin, np.nextafter(last + 1.0, 0))
            cell = np.floor(position).astype(np.int64)
            count = num_places[:, axis]
            place = np.minimum(np.floor((position - cell) * count).astype(np.int64), count - 1)
            cells.append(cell)
            places.append(place)
            if axis == 0:
                rounded = side * (cell + (place + 0.5) / count)
                target = means[:, 1] + shape[:, 1] / shape[:, 0] * (rounded - means[:, 0])
        return np.stack(cells, -1), np.stack(places, -1)


def opponent(colors: Floats, *, inverse: bool = False) -> Floats:
    """Rotate RGB [N, 3] into grey and two opponent colours, or back; do nothing for other numbers of channels."""
    if colors.shape[1] != 3:
        return colors
    rows = tuple(zip(*OPPONENT, strict=True)) if inverse else OPPONENT
    # the order of sums in a matrix product would depend on the machine
    return np.stack([colors[:, 0] * a + colors[:, 1] * b + colors[:, 2] * c for a, b, c in rows], -1)


def _decompose(cholesky: Floats) -> tuple[Floats, Floats, Floats]:
    """Return log2 of the mean scale, half the log2 of the ratio of scales, and the longer axis' angle in [0, pi)."""
    l11, l21, l22 = cholesky.T
    product = l11 * l22
    xx, xy, yy = l11 * l11, l11 * l21, l21 * l21 + l22 * l22
    half = 0.5 * (xx - yy)
    major = 0.5 * (xx + yy) + np.hypot(half, xy)
    ratio = 0.5 * np.log2(np.maximum(major / product, 1.0))
    return 0.5 * np.log2(product), ratio, 0.5 * np.arctan2(xy, half) % math.pi
