"""The Gaussians of a frame as plain tensors, and the image that they approximate."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from kcgs.fitting import FitConfig
from kcgs.fitting.descent import DRAFT_CUTOFF
from kcgs.functional import RegionMap, region_splat
from kcgs.functional.weights import inner_products, weighted_sums
from kcgs.nn import GaussianField
from kcgs.scene import Scene


class Splats(NamedTuple):
    """The arguments of :func:`kcgs.functional.region_splat` for one frame."""

    means: Tensor  # [N, 2]
    cholesky: Tensor  # [N, 3]
    colors: Tensor  # [N, C]
    region_ids: Tensor | None  # [N]
    regions: RegionMap | None

    @classmethod
    def of(cls, scene: Scene) -> Splats:
        """Copy a scene, without its graph."""
        field = scene.field
        means, cholesky, colors = (t.detach().clone() for t in (field.means, field.cholesky, field.merged_colors()))
        return cls(means, cholesky, colors, field.region_ids, scene.regions)

    @property
    def region_index(self) -> Tensor:
        """The region of each Gaussian, (N,), as a position in the map's ids; 0 without a map."""
        if self.regions is None or self.region_ids is None:
            return torch.zeros_like(self.means[:, 0], dtype=torch.int64)
        return self.regions.index_of(self.region_ids)

    def scene(self, size: tuple[int, int]) -> Scene:
        """Return a scene of them."""
        return Scene(GaussianField(*self[:4], size=size), self.regions)


def stack(frames: list[Splats], size: tuple[int, int], metadata: Mapping[str, str]) -> Scene:
    """Return the Gaussians and the maps of all frames as one scene."""
    means, cholesky, colors = (torch.stack(parts) for parts in zip(*(frame[:3] for frame in frames), strict=True))
    maps = [frame.regions for frame in frames if frame.regions is not None]
    if not maps:
        return Scene(GaussianField(means, cholesky, colors, size=size), None, metadata)
    region_ids = torch.stack([frame.region_ids for frame in frames if frame.region_ids is not None])
    # a pair of regions has the same softness in all frames
    softness: dict[tuple[int, int], float] = {}
    for regions in maps:
        softness |= regions.softness if isinstance(regions.softness, Mapping) else {}
    labels = torch.stack([regions.labels for regions in maps])
    regions = RegionMap.from_labels(labels, softness or maps[0].softness)
    return Scene(GaussianField(means, cholesky, colors, region_ids, size=size), regions, metadata)


@dataclass(frozen=True)
class Target:
    """The image of a frame, and the settings of its fit."""

    image: Tensor  # [C, H, W]
    config: FitConfig

    @property
    def size(self) -> tuple[int, int]:
        """(height, width)."""
        return self.image.shape[1], self.image.shape[2]

    def render(self, splats: Splats) -> Tensor:
        """Render (C, H, W), with the cutoff of a draft."""
        return region_splat(*splats, size=self.size, cutoff=self._cutoff, backend=self.config.backend)

    def inner_products(self, splats: Splats) -> Tensor:
        """Sum the render over the weights of each Gaussian, (N, C)."""
        return inner_products(*splats, size=self.size, cutoff=self._cutoff, backend=self.config.backend)

    @property
    def _cutoff(self) -> float:
        return max(self.config.cutoff, DRAFT_CUTOFF)

    def squared_error(self, splats: Splats) -> Tensor:
        """Return the squared error of each pixel, (H, W), channels averaged."""
        return (self.render(splats) - self.image).square().mean(0)

    def weight_sums(self, splats: Splats) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        """Sum weights per pixel, (1, H, W); return also what sums such maps per Gaussian, (N,): see `weighted_sums`."""
        ones = torch.ones_like(splats.colors[:, :1])
        total, sums = weighted_sums(lambda colors: self.render(splats._replace(colors=colors)), ones)
        return total, lambda values: sums(values)[:, 0]
