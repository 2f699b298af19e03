"""The table of a map, made of its labels and the softness of its contours."""

from __future__ import annotations

from torch import Tensor

from .labels import compact
from .softness import GivenSoftness, Softness, check_softness, for_each, softness_by_position
from .table import MapTable
from .tiles import with_tiles
from .widths import blurs_of, find_widths

# largest number of planes that a map keeps, 1 GiB; every render makes the tiles of a larger map, as a small file of
# noise may hold
_MOST_PLANES = 1 << 20


def table_of_labels(labels: Tensor, softness: GivenSoftness) -> tuple[MapTable, Softness]:
    """Return the table of valid int64 labels, (H, W) or (maps, H, W), and their softness, checked."""
    ids, index = compact(labels)
    positions = index if index.ndim == 3 else index[None]
    checked = check_softness(softness, ids, positions, labels.ndim == 3)
    by_position = for_each(checked, lambda one: softness_by_position(one, ids))
    widths, width_index = find_widths(positions, len(ids), by_position)
    blurs = None if widths == (0.0,) else blurs_of(widths, labels.device)
    return with_tiles(MapTable(labels, blurs, width_index, ids, positions), _MOST_PLANES), checked
