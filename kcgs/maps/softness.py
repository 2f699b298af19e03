"""Softness of contours, in pixels: one number, or one per pair of regions; a batch may have either for each map."""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

from kcgs._check import check_number
from kcgs.errors import InvalidArgument

from .labels import touching_pairs
from .resampled import contour_variance

T = TypeVar("T")

MAX_SOFTNESS = 64.0  # pixels: a wider blur is no contour
_PRINTED_PAIRS = 4  # most pairs that a repr lists


class PairSoftness(Mapping[tuple[int, int], float]):
    """Softness in pixels of the contour between each two regions: an immutable mapping, read in either order of ids.

    Example:
        >>> softness = PairSoftness({(1, 2): 0.7, (1, 5): 0.0})
        >>> softness[2, 1], softness
        (0.7, PairSoftness({(1, 2): 0.7, (1, 5): 0.0}))
    """

    __slots__ = ("_pixels",)

    def __init__(self, softness: Mapping[tuple[int, int], float]) -> None:
        self._pixels = dict(sorted(((min(pair), max(pair)), value) for pair, value in softness.items()))

    def __getitem__(self, pair: tuple[int, int]) -> float:
        return self._pixels[min(pair), max(pair)]

    def __iter__(self) -> Iterator[tuple[int, int]]:
        return iter(self._pixels)

    def __len__(self) -> int:
        return len(self._pixels)

    def __repr__(self) -> str:
        if len(self) <= _PRINTED_PAIRS:
            return f"PairSoftness({self._pixels})"
        return f"PairSoftness({len(self)} pairs, {min(self.values()):.3g} to {max(self.values()):.3g} pixels)"


Pairs = Mapping[tuple[int, int], float]
OneSoftness = float | PairSoftness
# softness of all maps, or of each map of a batch
Softness = OneSoftness | tuple[OneSoftness, ...]
# as users give it
GivenSoftness = float | Pairs | Sequence[float | Pairs]


def check_softness(softness: object, ids: Tensor, index: Tensor, is_batch: bool) -> Softness:
    """Return softness as one number where all pairs agree, else per pair; per map only where maps of a batch differ.

    Args:
        softness: as users give it.
        ids: of the map or the batch, sorted.
        index: position of each pixel's label among them, (maps, H, W).
        is_batch: whether each map may have its own softness.
    """
    if not isinstance(softness, list | tuple):
        return _check_one(softness, ids)
    if not is_batch or len(softness) != len(index):
        expected = f"one, or one for each of {len(index)} maps" if is_batch else "that of one map"
        raise InvalidArgument("softness", expected, f"{len(softness)} of them")
    parts = tuple(_check_one(part, ids[one.unique().long()]) for part, one in zip(softness, index, strict=True))
    return parts[0] if all(part == parts[0] for part in parts) else parts


def _check_one(softness: object, ids: Tensor) -> OneSoftness:
    if not isinstance(softness, Mapping):
        return check_number("softness", softness, 0.0, MAX_SOFTNESS, unit="pixels")
    known: set[int] = set(ids.tolist())
    pixels: dict[tuple[int, int], float] = {}
    for pair, value in softness.items():
        if not isinstance(pair, tuple) or len(pair) != 2 or not all(hasattr(i, "__index__") for i in pair):
            raise TypeError(f"softness must map pairs of ids to pixels; got the key {pair!r}")
        low, high = sorted(map(operator.index, pair))
        if low == high or not known.issuperset((low, high)):
            raise ValueError(f"softness must map pairs of two different ids in the map; got {pair!r}")
        if (low, high) in pixels:
            raise ValueError(f"softness must name a pair once; got {(low, high)} and {(high, low)}")
        pixels[low, high] = check_number(f"softness of {pair}", value, 0.0, MAX_SOFTNESS, unit="pixels")
    every_pair = len(pixels) == len(known) * (len(known) - 1) // 2
    distinct = {*pixels.values()} | (set() if every_pair else {0.0})
    return PairSoftness(pixels) if len(distinct) > 1 else distinct.pop() if distinct else 0.0


def softness_of_map(softness: Softness, number: int = 0) -> OneSoftness:
    """Return the softness of one map of a batch, or of a map without a batch."""
    return softness[number] if isinstance(softness, tuple) else softness


def softness_between(softness: OneSoftness, a: int, b: int) -> float:
    """Return the softness of the contour between two regions."""
    return softness if isinstance(softness, float) else softness.get((a, b), 0.0)


def largest_softness(softness: OneSoftness) -> float:
    """Return the softness of the softest contour."""
    return softness if isinstance(softness, float) else max(softness.values())


def mean_softness(softness: Softness) -> float:
    """Return the mean softness of the pairs that have one; of a batch, the mean over its maps."""
    if isinstance(softness, tuple):
        return sum(map(mean_softness, softness)) / len(softness)
    return softness if isinstance(softness, float) else sum(softness.values()) / len(softness)


def softness_by_position(softness: OneSoftness, ids: Tensor) -> float | dict[tuple[int, int], float]:
    """Return softness with every id replaced by its position among the sorted ids."""
    if not isinstance(softness, PairSoftness):
        return softness
    position = {region: place for place, region in enumerate(ids.tolist())}
    return {(position[a], position[b]): value for (a, b), value in softness.items()}


def scaled_softness(softness: OneSoftness, ratio: float) -> OneSoftness:
    """Return the softness as rendered at `ratio` new pixels per pixel of the map, at most `MAX_SOFTNESS`."""
    if not isinstance(softness, PairSoftness):
        return _scaled(softness, ratio)
    return PairSoftness({pair: _scaled(value, ratio) for pair, value in softness.items()})


def _scaled(softness: float, ratio: float) -> float:
    variance = torch.tensor(softness, dtype=torch.float64).square()
    return min(float(contour_variance(variance, ratio).sqrt()), MAX_SOFTNESS)


def merged_softness(softness: OneSoftness, merged_id: Callable[[int], int]) -> float | Mapping[tuple[int, int], float]:
    """Return the softness after a merge: a contour has the mean softness of the pairs that it is made of."""
    if isinstance(softness, float):
        return softness
    parts: dict[tuple[int, int], list[float]] = {}
    for (a, b), value in softness.items():
        low, high = sorted((merged_id(a), merged_id(b)))
        if low != high:
            parts.setdefault((low, high), []).append(value)
    return {pair: sum(values) / len(values) for pair, values in parts.items()}


def extended_softness(softness: OneSoftness, labels: Tensor, old_labels: Tensor) -> float | Pairs:
    """Return the softness of other labels: pairs that touch only there get the mean, unless they have a softness."""
    if isinstance(softness, float):
        return softness
    new_pairs = touching_pairs(labels) - touching_pairs(old_labels)
    return dict.fromkeys(new_pairs, mean_softness(softness)) | {**softness}


def softness_of_labels(softness: OneSoftness | Mapping[tuple[int, int], float], labels: Tensor) -> Any:
    """Return the softness without pairs of regions that the labels do not hold."""
    if not isinstance(softness, Mapping):
        return softness
    ids = set(labels.unique_consecutive().unique().tolist())  # sorting all pixels takes ten times as long
    return {pair: value for pair, value in softness.items() if ids.issuperset(pair)}


def for_each(softness: Softness, function: Callable[..., T], *parts: Iterable[Any]) -> T | tuple[T, ...]:
    """Apply a function to the softness of all maps, or to the softness and other arguments of each map."""
    if not isinstance(softness, tuple):
        return function(softness, *parts)
    return tuple(function(*arguments) for arguments in zip(softness, *parts, strict=True))


def softness_to_plain(softness: Softness) -> Any:
    """Return softness for JSON: a number, a list of [id, id, number], or {"maps": a list of either}."""
    if isinstance(softness, tuple):
        return {"maps": [softness_to_plain(part) for part in softness]}
    return softness if isinstance(softness, float) else [[*pair, width] for pair, width in softness.items()]


def softness_from_plain(plain: Any) -> Any:
    """Return the softness, as users give it, that `softness_to_plain` described."""
    if isinstance(plain, dict):
        return [softness_from_plain(part) for part in plain["maps"]]
    return {(low, high): value for low, high, value in plain} if isinstance(plain, list) else plain
