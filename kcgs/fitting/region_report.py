"""What became of a label map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch

from kcgs.maps import RegionMap
from kcgs.scene import Scene, empty_regions


@dataclass(frozen=True)
class RegionReport:
    """What became of the regions of a label map; its text is one line.

    `num_before` is `num_after` plus the merged regions, unless the whole map was dropped.

    Example:
        >>> print(RegionReport(num_before=40, num_after=28, merged_for_count=10, merged_for_bytes=2))
        28 of 40 regions kept; 10 merged: more than Gaussians; 2 merged: their contours save less than their bytes
    """

    num_before: int
    """Regions of the user's map."""
    num_after: int
    """Regions of the scene; 1: the scene has no map."""
    merged_for_count: int = 0
    """Regions that were merged into others because there were more regions than Gaussians."""
    merged_for_bytes: int = 0
    """Regions that were merged because their contours save less error than Gaussians of the same bytes."""
    dropped: Literal["recipe", "bytes"] | None = None
    """Why the map is not used: the recipe has no guidance, or Gaussians of the map's bytes save more error."""
    moved_pixels: int = 0
    """Pixels of the image that moved to another region."""
    empty: int = 0
    """Regions of the scene without a Gaussian: they are black."""
    empty_pixels: int = 0
    """Pixels of these empty regions."""

    def __str__(self) -> str:
        if self.dropped is not None:
            why = "the recipe uses none" if self.dropped == "recipe" else "Gaussians of its bytes save more error"
            return f"the map of {self.num_before} regions was dropped: {why}"
        one = self.num_after == 1 < self.num_before
        parts = [
            f"{self.num_before} regions became one" if one else f"{self.num_after} of {self.num_before} regions kept"
        ]
        merged = {
            "more than Gaussians": self.merged_for_count,
            "their contours save less than their bytes": self.merged_for_bytes,
        }
        parts += [f"{number} merged: {why}" for why, number in merged.items() if number]
        if self.moved_pixels:
            parts.append(f"{self.moved_pixels} pixels moved to others")
        if self.empty:
            parts.append(f"{self.empty} without a Gaussian, black: {self.empty_pixels} pixels")
        return "; ".join(parts)


def report_regions(
    original: RegionMap,
    scene: Scene,
    *,
    merged_for_bytes: int = 0,
    dropped: Literal["recipe", "bytes"] | None = None,
) -> RegionReport:
    """Compare the user's map with the scene's."""
    if dropped is not None:
        return RegionReport(original.num_regions, 1, dropped=dropped)
    regions, empty = scene.regions, empty_regions(scene)
    count = 1 if regions is None else regions.num_regions
    return RegionReport(
        original.num_regions, count, original.num_regions - count - merged_for_bytes, merged_for_bytes,
        moved_pixels=0 if regions is None else _moved_pixels(original, regions),
        empty=len(empty),
        empty_pixels=int(torch.isin(regions.labels, empty).sum()) if regions is not None and len(empty) else 0,
    )  # fmt: skip


def _moved_pixels(original: RegionMap, regions: RegionMap) -> int:
    """Count pixels that left their region's successor: the region of the same id, else that of most of its pixels."""
    before, after, count = original.index.flatten().long(), regions.index.flatten().long(), regions.num_regions
    into = regions.index_of(original.ids)
    pairs, shared = (before * count + after).unique(return_counts=True)
    most = torch.zeros_like(into).scatter_reduce_(0, pairs // count, shared, "amax")
    largest = pairs[(shared == most[pairs // count]) & (into[pairs // count] < 0)]
    into[largest // count] = largest % count
    return int((into.index_select(0, before) != after).sum())
