"""How wide contours are: one width for a whole map, or one for each pair of regions."""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Mapping

import torch
from torch import Tensor

from kcgs._check import check_number
from kcgs.kernels.membership import RADIUS_SIGMAS

MAX_SOFTNESS = 64.0  # pixels
CONTOURS = ("scaled", "crisp")
CRISP_WIDTH = 0.5  # pixels, of contours that are crisp
_FEW = 4


class PairWidths(Mapping[tuple[int, int], float]):
    """Contour width in pixels of pairs of regions: an immutable mapping with ids a < b, read in either order.

    Example:
        >>> widths = PairWidths({(1, 2): 0.7, (1, 5): 0.0})
        >>> widths[2, 1], widths
        (0.7, PairWidths({(1, 2): 0.7, (1, 5): 0.0}))
    """

    __slots__ = ("_widths",)

    def __init__(self, widths: Mapping[tuple[int, int], float]) -> None:
        self._widths = dict(sorted(((min(pair), max(pair)), width) for pair, width in widths.items()))

    def __getitem__(self, pair: tuple[int, int]) -> float:
        return self._widths[min(pair), max(pair)]

    def __iter__(self) -> Iterator[tuple[int, int]]:
        return iter(self._widths)

    def __len__(self) -> int:
        return len(self._widths)

    def __hash__(self) -> int:
        return hash(tuple(self._widths.items()))

    def __repr__(self) -> str:
        if len(self) <= _FEW:
            return f"PairWidths({self._widths})"
        return f"PairWidths({len(self)} pairs, {min(self.values()):.3g} to {max(self.values()):.3g} pixels)"


def check_softness(softness: object, ids: Tensor) -> float | PairWidths:
    """Return the width if all pairs have the same, else the widths of pairs."""
    if not isinstance(softness, Mapping):
        return check_number("softness", softness, 0.0, MAX_SOFTNESS, unit="pixels")
    known: set[int] = set(ids.tolist())
    widths: dict[tuple[int, int], float] = {}
    for pair, value in softness.items():
        if not isinstance(pair, tuple) or len(pair) != 2 or not all(hasattr(i, "__index__") for i in pair):
            raise TypeError(f"softness must map pairs of ids to widths; got the key {pair!r}")
        low, high = sorted(map(operator.index, pair))
        if low == high or not known.issuperset((low, high)):
            raise ValueError(f"softness must map pairs of two different ids in the map; got {pair!r}")
        if (low, high) in widths:
            raise ValueError(f"softness must name a pair once; got {(low, high)} and {(high, low)}")
        widths[low, high] = check_number(f"softness of {pair}", value, 0.0, MAX_SOFTNESS, unit="pixels")
    every_pair = len(widths) == len(known) * (len(known) - 1) // 2
    distinct = {*widths.values()} | (set() if every_pair else {0.0})
    return PairWidths(widths) if len(distinct) > 1 else distinct.pop() if distinct else 0.0


def scaled_widths(softness: float | PairWidths, scale: float) -> float | PairWidths:
    """Return the widths of a map that is scaled, at most `MAX_SOFTNESS`."""
    if not isinstance(softness, PairWidths):
        return min(softness * scale, MAX_SOFTNESS)
    return PairWidths({pair: min(width * scale, MAX_SOFTNESS) for pair, width in softness.items()})


def merged_widths(softness: float | PairWidths, find: Callable[[int], int]) -> float | Mapping[tuple[int, int], float]:
    """Return the widths where regions merge, `find` giving the new id: the mean of those that a contour is made of."""
    if isinstance(softness, float):
        return softness
    widths: dict[tuple[int, int], list[float]] = {}
    for (one, other), width in softness.items():
        low, high = sorted((find(one), find(other)))
        if low != high:
            widths.setdefault((low, high), []).append(width)
    return {pair: sum(found) / len(found) for pair, found in widths.items()}


def widths_of(softness: float | PairWidths, device: torch.device) -> Tensor | None:
    """Return widths as the operator takes them, float64; None: all contours are hard.

    One width, then half of its blur, from the middle, at the pixels of the map: (1 + taps,). Or, sorted, a row for
    each pair of ids before width and blur: (P, 3 + taps). So shapes say how far contours reach.
    """
    if softness == 0.0:
        return None
    widths = torch.tensor([softness] if isinstance(softness, float) else list(softness.values()), dtype=torch.float64)
    reach = (RADIUS_SIGMAS * widths).ceil()[:, None]
    distance = torch.arange(int(reach.max()) + 1, dtype=torch.float64)
    blurs = torch.exp(-0.5 * (distance / widths[:, None].clamp_min(1e-9)) ** 2)
    rows = torch.cat([widths[:, None], torch.where(distance <= reach, blurs, 0.0)], 1)
    if isinstance(softness, float):
        return rows[0].to(device)
    return torch.cat([torch.tensor(list(softness), dtype=torch.float64), rows], 1).to(device)


def check_contours(contours: str) -> str:
    """Return `contours` if it says how contours are rendered."""
    if contours not in CONTOURS:
        raise ValueError(f"contours must be one of {', '.join(CONTOURS)}; got {contours!r}")
    return contours


def crisp_widths(device: torch.device) -> Tensor:
    """Return widths as the operator takes them where contours are crisp: a number below 0."""
    return torch.full((1,), -1.0, dtype=torch.float64, device=device)


def is_crisp(widths: Tensor | None) -> bool:
    """Whether widths are those of :func:`crisp_widths`."""
    return widths is not None and widths.shape == (1,)


def softness_of(widths: Tensor | None) -> float | dict[tuple[int, int], float]:
    """Return what :func:`widths_of` was given."""
    if widths is None:
        return 0.0
    if widths.ndim == 1:
        return float(widths[0])
    return {(int(a), int(b)): width for a, b, width in widths[:, :3].tolist()}
