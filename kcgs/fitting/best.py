"""The best scene of each image of a fit."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from kcgs.functional import RegionMap
from kcgs.nn import GaussianField
from kcgs.scene import Scene

from .batch_maps import join_maps


class Best(NamedTuple):
    """A scene for each image that was measured, and how it ranks."""

    field: GaussianField
    """A batch of copies; rows that a scene lacks have the colour 0."""
    maps: list[RegionMap | None]
    """Of each image the map that it was rendered with, or the batch of maps that has it at the image's place."""
    is_draft: Tensor
    """Rendered with the cutoff of a draft: any scene that is none beats it; bool, (B,)."""
    value: Tensor
    """Squared error, or value of the objective, see `Objective.is_ranked_by_psnr`; (B,)."""
    psnr: Tensor
    """In dB, (B,)."""

    @property
    def scene(self) -> Scene:
        """The scenes as a batch."""
        return Scene(self.field, join_maps(self.maps))

    def improved_by(self, other: Best) -> Best:
        """Return for each image the better one: the other only where it has a lower value, or is the first final."""
        is_first_final = self.is_draft & ~other.is_draft
        is_lower = (other.value < self.value) & (self.is_draft == other.is_draft)
        wins = (is_first_final | is_lower) & ~other.value.isnan()
        if bool(wins.all()):
            return other
        if not bool(wins.any()):
            return self
        numbers = (torch.where(wins, new, old) for new, old in zip(other[2:], self[2:], strict=True))
        maps = [new if wins[k] else old for k, (new, old) in enumerate(zip(other.maps, self.maps, strict=True))]
        return Best(_choose(wins.to(self.field.means.device), other.field, self.field), maps, *numbers)


def _choose(mask: Tensor, first: GaussianField, second: GaussianField) -> GaussianField:
    """Return the images of the first field where the mask, (B,), is true, else those of the second."""
    most = max(first.num_gaussians, second.num_gaussians)

    def choose(a: Tensor, b: Tensor, fill: float) -> Tensor:
        a, b = (pad(table.detach(), (0, 0, 0, most - table.shape[1]), value=fill) for table in (a, b))
        return torch.where(mask[:, None, None], a, b)

    means, cholesky = choose(first.means, second.means, 1.0), choose(first.cholesky, second.cholesky, 1.0)
    ids = None
    if first.region_ids is not None and second.region_ids is not None:
        # a row that is added is of the region of the first one, which its map has
        ids = choose(_padded(first.region_ids, most), _padded(second.region_ids, most), 0)[..., 0]
    return GaussianField(means, cholesky, choose(first.colors, second.colors, 0.0), ids, size=first.size)


def _padded(ids: Tensor, count: int) -> Tensor:
    return torch.cat([ids, ids[:, :1].expand(-1, count - ids.shape[1])], 1)[..., None]
