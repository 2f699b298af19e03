"""A map as the operator takes it: tensors, and the size that it is rendered at."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from kcgs._labels import check_labels

from .coverage import Coverage
from .labels import compact
from .membership import Membership
from .resampled import Resampled, SmoothMembership

_KEPT_SIZES = 3  # of a map: a viewer renders at ever new sizes

# what maps are sampled from at other sizes, by the first tensor of their coverage, which it must not hold
_views: WeakTensorKeyDictionary = WeakTensorKeyDictionary()


class _Views:
    """The memberships of a map at other sizes than its own, those added last."""

    def __init__(self, smooth: SmoothMembership) -> None:
        self._smooth = smooth
        self._sizes: dict[tuple[int, int], Resampled] = {}

    def at(self, size: tuple[int, int]) -> Resampled:
        sizes = self._sizes
        if size not in sizes:
            # a new dict: another thread may read the present one
            self._sizes = sizes = dict([*sizes.items(), (size, Resampled(self._smooth, size))][-_KEPT_SIZES:])
        return sizes[size]


class MapOperands(NamedTuple):
    """A map at its own size, as a RegionMap has it, and the size of the image; of labels alone the rest is None."""

    labels: Tensor  # [H, W] or [maps, H, W] int64; nobody writes to those of a RegionMap
    blurs: Tensor | None = None  # [W, 2 + reach] float64, as of `blurs_of`, ascending; None: hard contours
    width_index: Tensor | None = None  # [maps, H, W] int32, row of each pixel; None: there is one
    ids: Tensor | None = None  # [R] int64, sorted
    starts: Tensor | None = None  # this and the next three: `Coverage`
    regions: Tensor | None = None
    planes: Tensor | None = None
    weights: Tensor | None = None
    size: tuple[int, int] = (0, 0)  # (height, width)

    @property
    def coverage(self) -> Coverage | None:
        """The table of the map at its own size; None: it is yet to be made."""
        if self.starts is None or self.regions is None or self.planes is None or self.weights is None:
            return None
        return Coverage(self.starts, self.regions, self.planes, self.weights)


def membership_at(operands: MapOperands) -> Membership:
    """Return the membership at the size of the operands; that of a RegionMap at another size is kept."""
    labels = operands.labels
    if operands.ids is None:
        check_labels("regions", labels)
        ids, index = compact(labels)
        membership = Membership(labels, ids, *operands[1:3])
        membership.index = index.view(membership.labels.shape)
    else:
        membership = Membership(labels, operands.ids, *operands[1:3])
    if operands.size == labels.shape[-2:]:
        if operands.coverage is not None:
            membership.coverage = operands.coverage
        return membership
    views: _Views | None = None if operands.starts is None else _views.get(operands.starts)
    if views is None:
        views = _Views(SmoothMembership(membership))
        if operands.starts is not None:
            _views[operands.starts] = views
    return views.at(operands.size)
