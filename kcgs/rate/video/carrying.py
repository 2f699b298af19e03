"""A frame that begins as the moved one before: contours move, Gaussians make room, what pays for its bits changes."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcgs.codec.clips.carried import Change, ClipPart, are_sound, born_codes
from kcgs.codec.clips.differences import Differences
from kcgs.codec.exact import Integers
from kcgs.codec.gaussians.quantize import Codes, Parameters, Quantizer
from kcgs.codec.labels.settling import settle_labels
from kcgs.fitting import FitConfig
from kcgs.fitting.contour_moves import accept_moves, refine_contours
from kcgs.fitting.objective import make_objective, propose_by
from kcgs.fitting.prefixes import energies
from kcgs.fitting.redundancy import least_missed
from kcgs.functional import RegionMap
from kcgs.nn import GaussianField
from kcgs.scene import Scene

from .following import Following

# what a bit must save, in units of the distortion
_BIT = 0.3
# iterations before contours move, before Gaussians make room, before rounding; and of rounding
_BEFORE, _CYCLE, _FREE, _ROUND = 10, 15, 45, 36
# share of N that may be tried as new ones beside those that there is room for; bits of a new one, and the share of what
# these must save that it must save in this frame, since it stays in those that follow
_SURPLUS, _BORN_BITS, _AT_ONCE = 0.05, 38.0, 0.3
_SIGMAS = (1.1, 1.8, 2.9, 4.7, 7.5, 12.0, 20.0)
# standard deviations outside the image at which a Gaussian goes
_OUTSIDE = 2.5
# contours move at most so many pixels from the map that is given or predicted, where the error does not rise by more
_MOST_MOVE, _RISE = 3.0, 1.5
# bits of a pixel whose label is not as predicted
_PIXEL_BITS = 3.0
# thickness of jitter, in pixels, that is left out of given maps
_JITTER = 2


class Carrying:
    """A frame on its way.

    Args:
        part: what the decoder knows.
        numbers: motions of the regions [R, 6], as a file has them.
        image: the frame, (C, H, W).
        given: its map as positions of the part's regions, (H, W) int32; None: it is carried on.
        config: of the clip's fits.
        qp: quantization parameter of the frame.
    """

    def __init__(
        self, part: ClipPart, numbers: Integers, image: Tensor, given: Any, config: FitConfig, qp: int
    ) -> None:
        self.part, self.image, self.given, self.config, self.qp = part, image, given, config, qp
        self.distortion = Quantizer(qp, part.size).distortion
        self.objective = make_objective(config.objective, image)
        moved, index = part.moved(numbers)
        self._predicted = index
        if index is not None and given is not None:
            index = settle_labels(given, index, _JITTER)
        self.index, region = index, part.frame.region
        self._left = np.zeros(len(region), np.bool_) if index is None else ~np.isin(region, np.unique(index))
        self._gone = (_are_outside(moved, part.size) | ~are_sound(moved)) & ~self._left
        stays = ~(self._left | self._gone)
        self._base, self._region = Parameters(*(numbers[stays] for numbers in moved)), region[stays]

    def fit(self, most: int, seed: int) -> Change:
        """Return what the file says of the frame, of at most so many Gaussians."""
        following = self._follow(self._base, self._region, 0)
        following.descend(_BEFORE)
        if self.index is not None:
            self._move_contours(following)
        added = self._propose(following, most)
        following = self._extend(following, added)
        following.descend(_CYCLE)
        kept = self._leave_out(following, most)
        stay, born = kept[: len(self._region)], self._born_region[kept[len(self._region) :]]
        following = self._shrink(following, kept, stay)
        following.descend(_FREE)
        codes = self._round_born(following, len(born))
        numbers = following.round(_ROUND, seed)[: int(stay.sum())]
        gone = self._gone.copy()
        gone[~(self._left | self._gone)] = ~stay
        return Change(self.index, gone, numbers, codes, born)

    def stand(self) -> Change:
        """Return that nothing changed but for the motions, the fewest bytes that a frame can have."""
        still = np.zeros((len(self._region), 5 + self.part.channels), np.int64)
        none = Parameters(np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, self.part.channels)))
        left = np.zeros(0, np.int64)
        return Change(self.index, self._gone, still, born_codes(none, self.qp, self.part.size), left)

    def _follow(self, base: Parameters, region: Integers, born: int) -> Following:
        ids = None if self.index is None else torch.from_numpy(self.part.ids[region])
        price = _BIT * self.distortion
        differences = Differences(base, self.distortion, self.part.size)
        return Following(self.image, self._regions(), ids, differences, born, price, self.objective)

    def _regions(self) -> RegionMap | None:
        return self.part.regions(self.index)

    def _move_contours(self, following: Following) -> None:
        """Let contours move where the image is explained better."""
        regions = self._regions()
        assert regions is not None
        if not self.config.move_contours or regions.num_regions == 1:
            return
        given = regions.labels if self.given is None else torch.from_numpy(self.part.ids[self.given])
        means, cholesky, colors = following.gaussians
        predicted = torch.from_numpy(self.part.ids[self._predicted])
        scene = Scene(GaussianField(means, cholesky, colors, following.region_ids, size=self.part.size), regions)
        with torch.no_grad():
            moved = refine_contours(
                scene, self.image, given=given, max_distance=_MOST_MOVE, length_weight=self.config.contour_cost
            )
            if moved is regions:
                return
            before = (following.render() - self.image).square().mean(0)
            following.regions = moved
            after = (following.render() - self.image).square().mean(0)
            gain = _RISE * before - after
            now = torch.from_numpy(self.part.ids[self.index]) != predicted
            gain -= self._pixel_price() * ((moved.labels != predicted).to(gain) - now.to(gain))
            moved = accept_moves(regions, moved, gain)
        self.index = np.searchsorted(self.part.ids, moved.labels.numpy()).astype(np.int32)
        following.regions = self._regions()

    def _pixel_price(self) -> float:
        """Return the squared error, the mean of channels, that a pixel must save that is not as predicted."""
        return _PIXEL_BITS * _BIT * self.distortion / len(self.image)

    def _propose(self, following: Following, most: int) -> Parameters:
        """Return new Gaussians that may pay for their bits, strongest first."""
        count = max(0, most - len(self._region)) + round(_SURPLUS * most)
        residual = self.image - following.render()
        added = propose_by(self.objective, residual, following.regions, count, sigmas=_SIGMAS)
        gain = energies(added.cholesky, added.colors, self.part.size)
        if self.objective is not None:
            gain *= self.objective.weigh(added.means, added.cholesky)
        pays = (gain > self._born_price()).nonzero()[:, 0]
        pays = pays[gain[pays].argsort(descending=True, stable=True)]
        ids = np.zeros(len(pays), np.int64) if added.region_ids is None else added.region_ids[pays].numpy()
        self._born_region = np.searchsorted(self.part.ids, ids) if self.index is not None else ids
        return Parameters(*(t[pays].double().numpy() for t in (added.means, added.cholesky, added.colors)))

    def _born_price(self) -> float:
        return _AT_ONCE * _BORN_BITS * _BIT * self.distortion

    def _extend(self, following: Following, added: Parameters) -> Following:
        base = Parameters(*(np.concatenate(pair) for pair in zip(self._base, added, strict=True)))
        longer = self._follow(base, np.concatenate([self._region, self._born_region]), len(self._born_region))
        new = longer.gaussians
        count = len(self._region)
        gaussians = [torch.cat([old, t[count:]]) for old, t in zip(following.gaussians, new, strict=True)]
        longer.take(gaussians, torch.cat([following.speed, longer.speed[count:]]))
        return longer

    def _leave_out(self, following: Following, most: int) -> NDArray[np.bool_]:
        """Leave out those that are missed least, down to `most`; return which stay, and hand on their colours."""
        means, cholesky, colors = (t.numpy() for t in following.gaussians)
        region = np.concatenate([self._region, self._born_region])
        saved = np.zeros(len(region))
        saved[len(self._region) :] = self._born_price()
        weight = following.weights().numpy()
        goes, handed = least_missed(means, cholesky, colors, region, len(region) - most, weight, saved)
        following.gaussians[2] = torch.from_numpy(handed).to(self.image)
        return ~goes

    def _shrink(self, following: Following, kept: NDArray[np.bool_], stay: NDArray[np.bool_]) -> Following:
        """Return what goes on with those that stay."""
        index = torch.from_numpy(kept)
        gaussians = [t[index] for t in following.gaussians]
        count = int(stay.sum())
        added = (t[count:].double().numpy() for t in gaussians)
        base = Parameters(*(np.concatenate([old[stay], new]) for old, new in zip(self._base, added, strict=True)))
        region = np.concatenate([self._region, self._born_region])[kept]
        shorter = self._follow(base, region, len(region) - count)
        shorter.take(gaussians, following.speed[index])
        return shorter

    def _round_born(self, following: Following, count: int) -> Codes:
        """Round new Gaussians, before the others, which make up for it; return their whole numbers."""
        start = len(following.gaussians[0]) - count
        found = Parameters(*(numbers[start:] for numbers in following.parameters()))
        codes = born_codes(found, self.qp, self.part.size)
        restored = Quantizer(self.qp, self.part.size).restore(codes)
        gaussians = [t.clone() for t in following.gaussians]
        for whole, rounded in zip(gaussians, restored, strict=True):
            whole[start:] = torch.from_numpy(rounded).to(whole)
        following.take(gaussians, following.speed)
        return codes


def _are_outside(gaussians: Parameters, size: tuple[int, int]) -> NDArray[np.bool_]:
    means, cholesky, _ = gaussians
    reach = _OUTSIDE * np.stack([cholesky[:, 0], np.hypot(cholesky[:, 1], cholesky[:, 2])], -1)
    beyond = (means < -reach) | (means > np.array([size[1], size[0]]) + reach)
    return np.asarray(beyond.any(1), np.bool_)
