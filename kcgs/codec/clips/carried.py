"""A frame that is carried on from the one before: motions, the map, what goes, what differs, what is new."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from kcgs.codec.adaptive import AdaptiveNumber, AdaptiveSymbols
from kcgs.codec.exact import Integers
from kcgs.codec.file import most_gaussians
from kcgs.codec.gaussians.layers import LayerCoder
from kcgs.codec.gaussians.quantize import ENERGIES, Codes, Parameters, Quantizer
from kcgs.codec.rangecoder import CodecError, Coder
from kcgs.functional import RegionMap
from kcgs.nn import GaussianField
from kcgs.scene import Scene

from .differences import NEW, DifferenceCoder, Differences, busyness
from .motion import MotionCoder, expand, move_gaussians

if TYPE_CHECKING:
    from kcgs.codec.labels import FollowingLabels

_FORTIETHS = 40  # of a pixel: contour widths are whole ones
# whether a Gaussian goes, by whether its centre is in the image, and what it did last
_GONE_WEIGHTS, _GONE_MEMORY = np.array([[40.0, 1.0]] * 4 + [[3.0, 1.0]] * 4), 2000.0
# standard deviations, in pixels, and centres and colours, that a decoder renders
_SIGMAS, _FARTHEST, _LOUDEST = (1e-3, 1e7), 1e8, 1e12
# factors that an encoder keeps to, since rounding changes them by half a step
LEAST_FACTOR, MOST_FACTOR = (2e-3, -5e6, 2e-3), 5e6


class Frame(NamedTuple):
    """What a decoder knows of a frame: Gaussians in float32, each with its region and a number of its own."""

    gaussians: Parameters
    region: Integers  # [N], positions among the ids of the clip's part
    key: Integers  # [N]
    index: Any  # (H, W) int32 positions, or None: no map
    numbers: Integers  # [R, 6], motions of the regions since the frame before, as the file has them


class Change(NamedTuple):
    """What an encoder says of a carried frame, after its motions."""

    index: Any  # (H, W) int32, or None
    gone: NDArray[np.bool_]  # [N] of the frame before
    codes: Integers  # [those that stay, 5 + C]
    born: Codes
    born_region: Integers


class ClipPart:
    """A key frame and those that are carried on from it: what was learned in one helps the next.

    Args:
        still: the key frame's scene, as its file decodes.
        first: the number of its first Gaussian; numbers go on from there.
    """

    def __init__(self, still: Scene, first: int = 0) -> None:
        field, regions = still.field, still.regions
        self.size, self.channels = still.size, field.colors.shape[-1]
        self.ids = np.zeros(1, np.int64) if regions is None else regions.ids.numpy()
        if regions is not None and regions.supersample > 1:
            raise ValueError(f"regions of a clip must have one label for each pixel; got {regions.supersample}**2")
        self._widths = None if regions is None else _Widths(regions)
        region = np.zeros(len(field), np.int64)
        if regions is not None and field.region_ids is not None:
            region = regions.index_of(field.region_ids).numpy().astype(np.int64)
        tensors = field.means, field.cholesky, field.merged_colors()
        gaussians = Parameters(*(t.detach().numpy().astype(np.float32) for t in tensors))
        key = np.arange(first, first + len(field), dtype=np.int64)
        index = None if regions is None else np.ascontiguousarray(regions.index[0].numpy().astype(np.int32))
        still_numbers = np.zeros((len(self.ids), 6), np.int64)
        self.frame, self.next_key = Frame(gaussians, region, key, index, still_numbers), first + len(field)
        self._activity = np.full(len(field), NEW, np.int64)
        self.motions = MotionCoder(len(self.ids))
        self._labels: FollowingLabels | None = None
        if index is not None:
            from kcgs.codec.labels import FollowingLabels  # loads numba

            self._labels = FollowingLabels(len(self.ids))
        self._gone = AdaptiveSymbols(_GONE_WEIGHTS, _GONE_MEMORY)
        self._births = AdaptiveNumber(np.array([2.0, *[1.0] * 20]))
        self._differences = DifferenceCoder(self.channels)

    def scene(self, frame: Frame | None = None) -> Scene:
        """Return a frame, by default the last one, as a scene."""
        gaussians, region, _, index, _ = frame or self.frame
        means, cholesky, colors = (torch.from_numpy(numbers) for numbers in gaussians)
        regions = self.regions(index)
        ids = None if regions is None else torch.from_numpy(self.ids[region])
        return Scene(GaussianField(means, cholesky, colors, ids, size=self.size), regions)

    def regions(self, index: Any) -> RegionMap | None:
        """Return the map of positions as regions, with the widths of the key frame; None for None, and one region."""
        if index is None or self._widths is None:
            return None
        labels = torch.from_numpy(self.ids[index])
        return RegionMap.from_labels(labels, self._widths.of(labels))

    def moved(self, numbers: Integers) -> tuple[Parameters, Any]:
        """Return the Gaussians in float64, and the map, that motions [R, 6] of a file predict."""
        motions = expand(numbers, self.size)
        index = None if self.frame.index is None else _move_labels(self.frame.index, motions)
        return move_gaussians(self.frame.gaussians, self.frame.region, motions), index

    def code(self, coder: Coder, qp: int, numbers: Integers | None, change: Change | None) -> Frame:
        """Code a frame; what is given is None to read it. It becomes the last one."""
        motions = self.motions.code(coder, self.size, numbers)
        last, quantizer = self.frame, Quantizer(qp, self.size)
        index = None
        if last.index is not None:
            assert self._labels is not None
            predicted = _move_labels(last.index, motions)
            index = self._labels.code(coder, predicted, None if change is None else change.index)
        moved = move_gaussians(last.gaussians, last.region, motions)
        stays = ~self._code_gone(coder, moved, None if change is None else change.gone)
        if index is not None:  # regions that left the image take their Gaussians with them
            stays &= np.isin(last.region, np.unique(index))
        base = Parameters(*(part[stays] for part in moved))
        differences = Differences(base, quantizer.distortion, self.size)
        given = None if change is None else change.codes
        codes = self._differences.code(coder, differences.strengths(), self._activity[stays], given)
        carried = differences.restore(codes)
        born, region = self._code_born(coder, quantizer, index, change, len(codes))
        gaussians = Parameters(*(np.concatenate(pair) for pair in zip(carried, born, strict=True)))
        _check(gaussians)
        keys = np.arange(self.next_key, self.next_key + len(region), dtype=np.int64)
        self.next_key += len(region)
        self._activity = np.concatenate([busyness(codes), np.full(len(region), NEW, np.int64)])
        region, key = np.concatenate([last.region[stays], region]), np.concatenate([last.key[stays], keys])
        self.frame = Frame(gaussians, region, key, index, self.motions.last)
        return self.frame

    def _code_gone(self, coder: Coder, moved: Parameters, gone: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
        x, y = moved.means.T
        outside = (x < 0) | (y < 0) | (x >= self.size[1]) | (y >= self.size[0])
        context = 4 * outside.astype(np.int64) + self._activity
        return self._gone.code(coder, context, None if gone is None else gone.astype(np.int64)) > 0

    def _code_born(
        self, coder: Coder, quantizer: Quantizer, index: Any, change: Change | None, stay: int
    ) -> tuple[Parameters, Integers]:
        count = self._births.code(coder, None if change is None else len(change.born_region))
        if not count + stay:
            raise CodecError("a frame must hold Gaussians; got none")
        if count + stay > most_gaussians(self.channels):
            raise CodecError(f"a frame must hold at most {most_gaussians(self.channels)} Gaussians; got {count + stay}")
        if not count:
            empty = np.zeros((0, self.channels), np.float32)
            return Parameters(empty[:, :0].reshape(0, 2), empty[:, :0].reshape(0, 3), empty), np.zeros(0, np.int64)
        regions = self.regions(index)
        here = np.zeros(1, np.int64) if regions is None else np.searchsorted(self.ids, regions.ids.numpy())
        model = LayerCoder(quantizer, self.channels, None if regions is None or len(here) == 1 else regions)
        groups, energy = None, 0
        if change is not None:
            positions = np.searchsorted(here, change.born_region)
            groups = _grouped(change.born, positions)
            energy = int(groups[0][0].energy[0])
        energy = coder.number(energy + 64, 128) - 64
        if not ENERGIES[0] <= energy <= ENERGIES[1]:
            raise CodecError(f"a class of energy must be {ENERGIES[0]} to {ENERGIES[1]}; got {energy}")
        parts = model.code(coder, energy, groups, count)
        born = Parameters(*(np.concatenate(numbers) for numbers in zip(*(part[0] for part in parts), strict=True)))
        region = here[np.concatenate([part[1] for part in parts])]
        if len(region) != count:
            raise CodecError(f"a frame must have as many new Gaussians as it says, {count}; got {len(region)}")
        return born, region


class _Widths:
    """The widths of a key frame's contours; pairs that touch later have the mean."""

    def __init__(self, regions: RegionMap) -> None:
        self._width = regions.softness
        self._mean = 0.0
        if isinstance(self._width, Mapping) and self._width:
            whole = [math.floor(width * _FORTIETHS + 0.5) for width in self._width.values()]
            self._mean = (sum(whole) // len(whole)) / _FORTIETHS

    def of(self, labels: torch.Tensor) -> float | dict[tuple[int, int], float]:
        if not isinstance(self._width, Mapping):
            return self._width
        from kcgs.functional.labels import touching_pairs

        return {pair: self._width.get(pair, self._mean) for pair in touching_pairs(labels)}


def _move_labels(index: Any, motions: Integers) -> Any:
    from kcgs.codec.labels import move_labels  # loads numba

    return move_labels(index, motions)


def _grouped(codes: Codes, region: Integers) -> list[tuple[Codes, Integers]]:
    """Return Gaussians as layers hold them: a group for each energy, the highest first."""
    order = np.lexsort((codes.cell[:, 0], codes.cell[:, 1], -codes.size, -codes.energy))
    codes, region = codes.pick(order), region[order]
    starts = np.flatnonzero(np.diff(codes.energy, prepend=codes.energy[0] + 1))
    ends = [*starts[1:].tolist(), len(region)]
    return [(codes.pick(slice(a, b)), region[a:b]) for a, b in zip(starts.tolist(), ends, strict=True)]


def born_codes(gaussians: Parameters, qp: int, size: tuple[int, int]) -> Codes:
    """Return Gaussians that are born as whole numbers; those that would be too thin to render are round."""
    quantizer = Quantizer(qp, size)

    def rounded(gaussians: Parameters) -> Codes:
        return quantizer.quantize(gaussians, quantizer.classify(gaussians))

    codes = rounded(gaussians)
    thin = ~are_sound(quantizer.restore(codes))
    if thin.any():
        scale = np.sqrt(gaussians.cholesky[:, 0] * gaussians.cholesky[:, 2])
        circles = np.stack([scale, np.zeros_like(scale), scale], -1)
        codes = rounded(gaussians._replace(cholesky=np.where(thin[:, None], circles, gaussians.cholesky)))
    return codes


def are_sound(gaussians: Parameters) -> NDArray[np.bool_]:
    """Say of each Gaussian, as float32 has it, whether a decoder renders it, [N]."""
    means, cholesky, colors = (numbers.astype(np.float32) for numbers in gaussians)
    sound = (cholesky[:, ::2] > _SIGMAS[0]).all(1) & (np.abs(cholesky) < _SIGMAS[1]).all(1)
    return np.asarray(sound & (np.abs(means) < _FARTHEST).all(1) & (np.abs(colors) < _LOUDEST).all(1), np.bool_)


def _check(gaussians: Parameters) -> None:
    """Refuse numbers that cannot be rendered."""
    if not are_sound(gaussians).all():
        raise CodecError("a frame holds Gaussians that cannot be rendered")
