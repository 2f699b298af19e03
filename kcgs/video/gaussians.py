"""The Gaussians of one frame and their map, as plain tensors."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from kcgs.functional import RegionMap
from kcgs.nn import GaussianField
from kcgs.scene import Scene


class Gaussians(NamedTuple):
    """Gaussians, their region ids, and the map."""

    means: Tensor  # [N, 2]
    cholesky: Tensor  # [N, 3]
    colors: Tensor  # [N, C]
    region_ids: Tensor | None  # [N]
    regions: RegionMap | None

    def detached(self) -> Gaussians:
        """Copy, without the graph."""
        means, cholesky, colors = (t.detach().clone() for t in self[:3])
        return Gaussians(means, cholesky, colors, self.region_ids, self.regions)

    def scene(self, size: tuple[int, int]) -> Scene:
        """Make a scene of them."""
        means, cholesky, colors = (t.detach() for t in self[:3])
        return Scene(GaussianField(means, cholesky, colors, self.region_ids, size=size), self.regions)
