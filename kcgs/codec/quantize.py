r"""Gaussians as whole numbers, each number as fine as the picture needs it.

A change of one parameter changes the picture by a squared error that is known without drawing: with the amplitude
:math:`|c|` and the standard deviations :math:`\sigma_1 \ge \sigma_2`, :math:`w = \pi |c|^2 \sigma_1 \sigma_2` is the
Gaussian's energy, and

===========================================  ==========================  ========================
parameter                                    changed by                  squared error
===========================================  ==========================  ========================
centre, in standard deviations               :math:`\delta`              :math:`w \delta^2 / 2`
log of :math:`\sqrt{\sigma_1 \sigma_2}`      :math:`\delta`              :math:`2 w \delta^2`
half the log of :math:`\sigma_1 / \sigma_2`  :math:`\delta`              :math:`w \delta^2`
angle, times :math:`\sinh` of that log       :math:`\delta`              :math:`w \delta^2`
colour, one channel                          :math:`\delta`              :math:`(w / |c|^2) \delta^2`
===========================================  ==========================  ========================

At a given size the total is least where every parameter of every Gaussian adds the same error, the noise D. So faint
and small Gaussians get coarse shapes, and wide ones fine colours. Nothing counts beyond the picture: a Gaussian wider
than that has the picture's area in place of its own. The steps are read from two classes: energy (octaves
of :math:`|c| \sqrt{\sigma_1 \sigma_2}`) and size (three quarters of an octave of :math:`\sqrt{\sigma_1 \sigma_2}`).

What is restored is computed from sums, products, quotients and square roots of float64 alone (`exact`): the same bits
on every machine that does them in the order of the code, :class:`Quantizer`. In short, with D = 2^(-code / 32), classes
e of energy and s of size, and A = min(pi 2^(1.5 (s + 1/2)), H W), u = sqrt(12 D / pi * 2^(-2 e - 1)):

- there are S = floor(0.75 / (sqrt(1/2) / ln 2 * u) + 1/2) scales in a class (1 to 2^20): log2 of
  sqrt(sigma_1 sigma_2) is m = 0.75 (s + (scale + 1/2) / S);
- half the log2 of sigma_1 / sigma_2 is h = ratio * max(u / ln 2, 12 / 2^20);
- there are T = floor(pi sinh(2 h ln 2) / u + 1/2) angles (2 to 2^20; 1 for ratio 0): that of the longer axis, from x
  to y, is pi * angle / T; sigma_1 = 2^(m + h) along it, sigma_2 = 2^(m - h) across give ``cholesky``;
- colours are counted in steps of sqrt(12 D / A); three channels are the rotated ones (`opponent`);
- a cell of side a has X = ceil(a / (sqrt(2) u l11)) places across and Y = ceil(a / (sqrt(2) u l22)) down (1 to 2^20):
  x = a (column + (place + 1/2) / X), and so y.

Centres, factors and colours are then rounded to float32.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .cells import Grid
from .exact import Floats, exp2, turn

Integers = NDArray[np.int64]

ENERGIES = (-24, 40)
SIZES = (-8, 28)
# octaves that a class of size spans
OCTAVES = 0.75
# the noise that a file may ask for: D = 2^(-code / 32)
NOISE_CODES = (-512, 1023)
# half the log2 of the ratio of standard deviations
_MOST_RATIO = 12.0
_MOST_LEVELS = 1 << 20
# steps that a colour may have
MOST_COLOR = 1 << 24
_LN2 = 0.6931471805599453
# an opposition of colours: grey, red against blue, green against both; orthonormal
_OPPONENT = (
    (0.5773502691896258, 0.5773502691896258, 0.5773502691896258),
    (0.7071067811865476, 0.0, -0.7071067811865476),
    (-0.408248290463863, 0.816496580927726, -0.408248290463863),
)


class Classes(NamedTuple):
    """What the steps are read from, for each Gaussian."""

    energy: Integers  # [N]
    size: Integers  # [N]


class Codes(NamedTuple):
    """N Gaussians as whole numbers."""

    classes: Classes
    scale: Integers  # [N] place within the class of size
    ratio: Integers  # [N] of the standard deviations
    angle: Integers  # [N] of the longer one
    colors: Integers  # [N, C] grey first
    cell: Integers  # [N, 2] column, row
    place: Integers  # [N, 2] within the cell


class Restored(NamedTuple):
    """N Gaussians as they are drawn."""

    means: NDArray[np.float32]  # [N, 2]
    cholesky: NDArray[np.float32]  # [N, 3]
    colors: NDArray[np.float32]  # [N, C]


class Steps(NamedTuple):
    """How fine each number is."""

    place: Floats  # [N] in standard deviations
    scales: Integers  # [N] places in a class of size
    ratio: Floats  # [N] in log2
    angle: Floats  # [N] radians, times sinh of the log ratio
    color: Floats  # [N]


class Quantizer:
    """Whole numbers from Gaussians, and back, at one noise.

    Args:
        noise_code: the noise is D = 2^(-noise_code / 32), squared error that a parameter adds to the picture.
        size: (height, width) of the picture.
    """

    def __init__(self, noise_code: int, size: tuple[int, int]) -> None:
        self.noise_code, self.size = noise_code, size
        self.noise = float(exp2(np.array([-noise_code / 32.0]))[0])
        energies, sizes = (np.arange(low, high + 1, dtype=np.float64) for low, high in (ENERGIES, SIZES))
        self._relative = np.sqrt(12.0 * self.noise / math.pi * exp2(-2.0 * energies - 1.0))  # by energy
        area = np.minimum(math.pi * exp2(2.0 * OCTAVES * (sizes + 0.5)), float(size[0] * size[1]))
        self._color = np.sqrt(12.0 * self.noise / area)  # by size

    def classify(self, cholesky: Floats, colors: Floats) -> Classes:
        """Return the classes of Gaussians with `cholesky` [N, 3] and `colors` [N, C]."""
        scale = 0.5 * np.log2(cholesky[:, 0] * cholesky[:, 2])
        within = np.minimum(scale, 0.5 * math.log2(self.size[0] * self.size[1] / math.pi))
        energy = np.log2(np.maximum(np.sqrt((colors * colors).sum(1)), 1e-12)) + within
        return Classes(
            np.clip(np.floor(energy), ENERGIES[0], ENERGIES[1]).astype(np.int64),
            np.clip(np.floor(scale / OCTAVES), SIZES[0], SIZES[1]).astype(np.int64),
        )

    def steps(self, classes: Classes) -> Steps:
        """Return the steps of each Gaussian: those at which every parameter adds the noise."""
        relative: Floats = self._relative[classes.energy - ENERGIES[0]]
        scale = relative * (math.sqrt(0.5) / _LN2)
        return Steps(
            place=relative * math.sqrt(2.0),
            scales=np.clip(np.floor(OCTAVES / scale + 0.5), 1, _MOST_LEVELS).astype(np.int64),
            ratio=np.maximum(relative * (1.0 / _LN2), _MOST_RATIO / _MOST_LEVELS),
            angle=relative,
            color=self._color[classes.size - SIZES[0]],
        )

    def cell_side(self, classes: Classes) -> Integers:
        """Return the side in pixels, a power of two, of the cells that each Gaussian's place is told in."""
        group = (classes.energy - ENERGIES[0]) * 64 + classes.size - SIZES[0]
        counts = np.bincount(group)
        sides = np.zeros(len(counts), np.int64)
        for held in np.flatnonzero(counts).tolist():
            sides[held] = Grid.over(self.size, int(counts[held])).side
        found: Integers = sides[group]
        return found

    def is_seen(self, colors: Floats, classes: Classes) -> NDArray[np.bool_]:
        """Say which Gaussians do not round to black [N]."""
        rounded = np.floor(opponent(colors) / self.steps(classes).color[:, None] + 0.5)
        seen: NDArray[np.bool_] = (rounded != 0).any(1)
        return seen

    def quantize(self, means: Floats, cholesky: Floats, colors: Floats, classes: Classes) -> Codes:
        """Round Gaussians; what leaves its class of size is brought back to its border."""
        steps = self.steps(classes)
        scale, ratio, angle = _decompose(cholesky)
        within = np.floor((scale / OCTAVES - classes.size) * steps.scales).astype(np.int64)
        within = np.clip(within, 0, steps.scales - 1)
        ratios = np.floor(np.clip(ratio, 0, _MOST_RATIO) / steps.ratio + 0.5).astype(np.int64)
        turns = self.angles(ratios, steps)
        angles = np.floor(angle / math.pi * turns + 0.5).astype(np.int64) % turns
        opposed = np.floor(opponent(colors) / steps.color[:, None] + 0.5)
        if not (np.abs(opposed) < MOST_COLOR).all():
            raise ValueError(
                f"colors must be below {MOST_COLOR:g} steps of {steps.color.min():.3g} at this quality; got colors "
                f"up to {np.abs(colors).max():.3g}"
            )
        codes = opposed.astype(np.int64)
        shape = self.restore_shape(classes, steps, within, ratios, angles / turns)
        cell, place = self._locate(means, shape, steps, self.cell_side(classes))
        return Codes(classes, within, ratios, angles, codes, cell, place)

    def most_ratio(self, steps: Steps) -> Integers:
        """Return the largest code of a ratio [N]."""
        return np.floor(_MOST_RATIO / steps.ratio + 0.5).astype(np.int64)

    def angles(self, ratios: Integers, steps: Steps) -> Integers:
        """Return how many angles there are at each ratio: one for circles."""
        log = 2.0 * ratios * steps.ratio
        grown, shrunk = exp2(np.stack([log, -log]))
        stretch = 0.5 * (grown - shrunk)
        turns = np.clip(np.floor(math.pi * stretch / steps.angle + 0.5), 2, _MOST_LEVELS)
        return np.where(ratios == 0, 1, turns).astype(np.int64)

    def restore_shape(self, classes: Classes, steps: Steps, scale: Integers, ratio: Integers, share: Floats) -> Floats:
        """Return `cholesky` [N, 3]; `share` is the angle's code by how many there are."""
        middle = OCTAVES * (classes.size + (scale + 0.5) / steps.scales)
        stretch = ratio * steps.ratio
        major, minor = exp2(np.stack([middle + stretch, middle - stretch]))
        cos, sin = turn(share)
        along, across = major * cos, minor * sin
        l11 = np.sqrt(along * along + across * across)
        return np.stack([l11, (major * major - minor * minor) * cos * sin / l11, major * minor / l11], -1)

    def parts(self, shape: Floats, steps: Steps, side: Integers) -> Integers:
        """Return how many places there are in a cell, across and down [N, 2]."""
        step = steps.place[:, None] * shape[:, ::2]
        return np.clip(np.ceil(side[:, None] / step), 1, _MOST_LEVELS).astype(np.int64)

    def restore(self, codes: Codes) -> Restored:
        """Return the numbers of Gaussians."""
        steps = self.steps(codes.classes)
        share = codes.angle / self.angles(codes.ratio, steps)
        shape = self.restore_shape(codes.classes, steps, codes.scale, codes.ratio, share)
        return self.restore_rest(codes, steps, shape, self.cell_side(codes.classes))

    def restore_rest(self, codes: Codes, steps: Steps, shape: Floats, side: Integers) -> Restored:
        """Return the numbers of Gaussians whose shapes are known."""
        means = side[:, None] * (codes.cell + (codes.place + 0.5) / self.parts(shape, steps, side))
        colors = opponent(codes.colors * steps.color[:, None], back=True)
        return Restored(means.astype(np.float32), shape.astype(np.float32), colors.astype(np.float32))

    def _locate(self, means: Floats, shape: Floats, steps: Steps, side: Integers) -> tuple[Integers, Integers]:
        """Round x, then y to where it counts: the error of x along the Gaussian's slant is made up for."""
        parts = self.parts(shape, steps, side)
        sides, which = np.unique(side, return_inverse=True)
        margin = np.array([Grid.of_side(self.size, one).most_margin for one in sides.tolist()], np.int64)[which]
        cells, places = [], []
        wanted = means[:, 0]
        for axis, pixels in enumerate((self.size[1], self.size[0])):
            highest = -(-pixels // side) + margin - 1
            at = np.clip(wanted / side, -margin, np.nextafter(highest + 1.0, 0))
            cell = np.floor(at).astype(np.int64)
            place = np.minimum(np.floor((at - cell) * parts[:, axis]).astype(np.int64), parts[:, axis] - 1)
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
    rows = tuple(zip(*_OPPONENT, strict=True)) if back else _OPPONENT
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
