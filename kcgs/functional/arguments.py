"""The arguments of the operator `kcgs::region_splat`."""

from __future__ import annotations

from typing import Any, NamedTuple

from torch import Tensor

from kcgs.maps import MapTable

# place of the table's first field in the schema
TABLE_PLACE = 4
# the operator takes the fields of a table one by one, since operators of torch take no NamedTuple
SCHEMA = (
    "Tensor means, Tensor cholesky, Tensor colors, Tensor? region_ids, "
    + ", ".join(f"Tensor? {name}" for name in MapTable._fields)
    + ", SymInt height, SymInt width, float cutoff, str backend"
)
NUM_ARGUMENTS = len(SCHEMA.split(", "))


class SplatArguments(NamedTuple):
    """The arguments of the operator; floating tensors share one dtype, float32 or float64.

    For one image B may be left out of means, cholesky, colors and region_ids together; the image then has no B either.
    """

    means: Tensor  # [B, N, 2]
    cholesky: Tensor  # [B, N, 3]
    colors: Tensor  # [B, N, C]
    region_ids: Tensor | None  # [B, N] int64
    table: MapTable | None  # of the map at its own size; None: one region covers everything
    size: tuple[int, int]  # (height, width) of the image
    cutoff: float
    backend: str

    @classmethod
    def of(cls, *values: Any) -> SplatArguments:
        """Take the arguments in the order of the schema."""
        means, cholesky, colors, region_ids, *fields, height, width, cutoff, backend = values
        table = None if fields[0] is None else MapTable(*fields)
        return cls(means, cholesky, colors, region_ids, table, (height, width), cutoff, backend)

    def flatten(self) -> tuple[Any, ...]:
        """Return the arguments in the order of the schema."""
        table = [None] * len(MapTable._fields) if self.table is None else self.table
        return (*self[:TABLE_PLACE], *table, *self.size, self.cutoff, self.backend)
