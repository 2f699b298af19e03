"""The best scene of each image of a fit."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kcgs.maps import RegionMap
from kcgs.nn import GaussianField, pad_rows
from kcgs.scene import Scene

from .image_maps import join_maps


class Best(NamedTuple):
    """The best measured scene of each image, and the numbers that rank it."""

    field: GaussianField
    """A batch of copies; rows that a scene lacks are unused."""
    maps: list[RegionMap | None]
    """For each image the map of its render: of a batch of maps, the map at the image's index."""
    is_draft: Tensor
    """True for a scene rendered with the draft cutoff: all with the final cutoff rank higher. Bool, (B,)."""
    value: Tensor
    """Squared error, or value of the objective (see `Objective.is_ranked_by_psnr`), (B,)."""
    psnr: Tensor
    """PSNR in dB, (B,)."""

    @property
    def scene(self) -> Scene:
        """The scenes as a batch."""
        return Scene(self.field, join_maps(self.maps))

    def improved_by(self, other: Best) -> Best:
        """Return the better scene of each image: `other` where its value is lower, or where only `self` is a draft."""
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
    first, second = pad_rows(first, most), pad_rows(second, most)
    means, cholesky, colors = (
        torch.where(mask[:, None, None], getattr(first, name).detach(), getattr(second, name).detach())
        for name in ("means", "cholesky", "colors")
    )
    ids = None
    if first.region_ids is not None and second.region_ids is not None:
        ids = torch.where(mask[:, None], first.region_ids, second.region_ids)
    return GaussianField(means, cholesky, colors, ids, size=first.size)
