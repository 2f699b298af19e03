"""Scenes as the frames of a clip, without their images: each is rounded to its differences from the one before."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from kcgs.codec.exact import Floats, Integers
from kcgs.codec.gaussians.quantize import Parameters, Quantizer
from kcgs.codec.scenes import SceneWriter, deserialize
from kcgs.scene import Scene, check_scene

from .carried import LEAST_FACTOR, MOST_FACTOR, Change, ClipPart, are_sound, born_codes
from .differences import Differences
from .file import KEY, ClipHeader, Record
from .frames import FrameReader, begin_part, carried_record, read_qp

# Gaussians are the same where centres, in these standard deviations, logarithms of sizes and colours, in these, agree,
# and energy does not grow more than so many times: steps would be too large
_PIXELS, _LOGARITHMS, _COLORS, _FARTHEST, _LOUDER = 4.0, 0.5, 0.25, 2.0, 2.0
_APART = 1e3  # of regions
# share of new Gaussians above which a frame is as fine as its key frame: no descent makes up for how they are rounded
_MANY = 0.02


class Asked(NamedTuple):
    """How a frame is to be written."""

    qp: int
    numbers: Integers | None  # motions of the regions by their ids' positions [R, 6]; None: a key frame
    ids: Integers  # of the regions
    born: int = 0  # Gaussians that were new


def asked_of(records: list[Record], header: ClipHeader) -> Iterable[tuple[Asked, Scene]]:
    """Yield how each frame of a clip was written, and the frame."""
    reader = FrameReader(header)
    first = 0
    for record in records:
        frame = reader.read(record)
        part = reader.part
        assert part is not None
        numbers = None if record.kind == KEY else frame.numbers
        yield Asked(read_qp(record)[0], numbers, part.ids, part.next_key - first), part.scene(frame)
        first = part.next_key


class ClipWriter:
    """Writes scenes one after another, all of one size."""

    def __init__(self) -> None:
        self._part: ClipPart | None = None
        self._key_qp = 0

    def add(self, scene: Scene, asked: Asked) -> Record:
        """Write the next frame; a key frame where that is asked for, or the last one does not know its regions."""
        scene = check_scene(scene)
        part = self._part
        if part is None or asked.numbers is None or not _knows(part, scene):
            self._key_qp = asked.qp if asked.numbers is None else max(asked.qp, self._key_qp)
            data = SceneWriter(scene).write_rounded(self._key_qp)
            self._part = begin_part(deserialize(data), part)
            return Record(KEY, data)
        numbers = part.motions.last.copy()
        both, mine, theirs = np.intersect1d(part.ids, asked.ids, return_indices=True)
        if len(both):
            numbers[mine] = asked.numbers[theirs]
        qp, change = asked.qp, _change(part, numbers, scene, asked.qp)
        if qp < self._key_qp and len(change.born_region) - asked.born > _MANY * len(scene.field):
            qp, change = self._key_qp, _change(part, numbers, scene, self._key_qp)
        return carried_record(part, qp, numbers, change)


def _knows(part: ClipPart, scene: Scene) -> bool:
    """Say whether a scene's regions are those of a part, or fewer."""
    regions = scene.regions
    if part.frame.index is None:
        return regions is None or regions.num_regions == 1
    return regions is not None and bool(np.isin(regions.ids.numpy(), part.ids).all())


def _change(part: ClipPart, numbers: Integers, scene: Scene, qp: int) -> Change:
    """Return how a scene differs from the moved frame before."""
    moved, predicted = part.moved(numbers)
    field, index, region = scene.field, None, np.zeros(len(scene.field), np.int64)
    if predicted is not None:
        assert scene.regions is not None and field.region_ids is not None
        index = np.searchsorted(part.ids, scene.regions.labels.numpy()).astype(np.int32)
        region = np.searchsorted(part.ids, field.region_ids.numpy())
    tensors = field.means, field.cholesky, field.merged_colors()
    new = Parameters(*(t.detach().double().numpy() for t in tensors))
    new = new._replace(cholesky=new.cholesky.clip(LEAST_FACTOR, MOST_FACTOR))
    last = part.frame.region
    left = np.zeros(len(last), np.bool_) if index is None else ~np.isin(last, np.unique(index))
    old, found = _match(moved, last, new, region)
    kept = ~left[old] & are_sound(moved)[old]
    old, found = old[kept], found[kept]
    differences = Differences(_pick(moved, old), Quantizer(qp, part.size).distortion, part.size)
    codes = np.floor(differences.measure(_pick(new, found)) + 0.5).astype(np.int64)
    kept = differences.can_be(codes)
    old, found, codes = old[kept], found[kept], codes[kept]
    gone = ~left
    gone[old] = False
    born = np.setdiff1d(np.arange(len(region)), found)
    return Change(index, gone, codes, born_codes(_pick(new, born), qp, part.size), region[born])


def _pick(gaussians: Parameters, which: Integers) -> Parameters:
    return Parameters(*(numbers[which] for numbers in gaussians))


def _match(old: Parameters, old_region: Integers, new: Parameters, new_region: Integers) -> tuple[Integers, Integers]:
    """Return which Gaussians of two frames are the same, in the first one's order: those nearest to each other."""
    from scipy.spatial import cKDTree

    first, second = _features(old, old_region), _features(new, new_region)
    distance, forth = cKDTree(second).query(first, distance_upper_bound=_FARTHEST)
    _, back = cKDTree(first).query(second)
    near = np.flatnonzero(np.isfinite(distance))
    mutual = near[back[forth[near]] == near]
    louder = _energies(new)[forth[mutual]] > _LOUDER * _energies(old)[mutual]
    return mutual[~louder], forth[mutual[~louder]]


def _energies(gaussians: Parameters) -> Floats:
    _, cholesky, colors = gaussians
    return np.asarray((colors * colors).sum(1) * cholesky[:, 0] * cholesky[:, 2])


def _features(gaussians: Parameters, region: Integers) -> Floats:
    means, cholesky, colors = gaussians
    logs = np.log(np.maximum(cholesky[:, ::2], 1e-6)) / _LOGARITHMS
    parts: list[Any] = [means / _PIXELS, logs, colors / _COLORS, _APART * region[:, None]]
    return np.concatenate(parts, 1)
