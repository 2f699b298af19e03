"""What became of a label map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch

from kcgs.functional import RegionMap
from kcgs.scene import Scene, empty_regions


@dataclass(frozen=True)
class RegionReport:
    """What became of the regions of a label map; as text, one line.

    `given` is the sum of `kept` and of what was merged, unless the map was dropped as a whole.

    Example:
        >>> print(RegionReport(given=40, kept=28, merged_for_count=10, merged_for_bytes=2))
        28 of 40 regions kept; 10 merged: more than Gaussians; 2 merged: their contours save less than their bytes
    """

    given: int
    """Regions of the map that was given."""
    kept: int
    """Regions of the scene; 1: it has no map."""
    merged_for_count: int = 0
    """Regions that went into others since there were more than Gaussians."""
    merged_for_bytes: int = 0
    """Those whose contours save less error than Gaussians for their bytes."""
    dropped: Literal["recipe", "bytes"] | None = None
    """Why the map is not used: the recipe confines nothing, or the map's bytes do more as Gaussians."""
    moved_pixels: int = 0
    """Pixels of the image that moved to another region."""
    empty: int = 0
    """Regions of the scene without a Gaussian: they are black."""
    empty_pixels: int = 0
    """Pixels of the image that are most of all theirs."""

    def __str__(self) -> str:
        if self.dropped is not None:
            why = "the recipe uses none" if self.dropped == "recipe" else "its bytes do more as Gaussians"
            return f"the map of {self.given} regions was dropped: {why}"
        one = self.kept == 1 < self.given
        parts = [f"{self.given} regions became one" if one else f"{self.kept} of {self.given} regions kept"]
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
    given: RegionMap | None,
    scene: Scene,
    *,
    merged_for_bytes: int = 0,
    dropped: Literal["recipe", "bytes"] | None = None,
) -> RegionReport | None:
    """Compare the map that was given with the scene's."""
    if given is None:
        return None
    if dropped is not None:
        return RegionReport(given.num_regions, 1, dropped=dropped)
    regions, empty = scene.regions, empty_regions(scene)
    kept = 1 if regions is None else regions.num_regions
    return RegionReport(
        given.num_regions, kept, given.num_regions - kept - merged_for_bytes, merged_for_bytes,
        moved_pixels=0 if regions is None else _moved_pixels(given, regions),
        empty=len(empty),
        empty_pixels=int(torch.isin(regions.labels, empty).sum()) if regions is not None and len(empty) else 0,
    )  # fmt: skip


def _moved_pixels(given: RegionMap, regions: RegionMap) -> int:
    """Count the pixels that are not where their region went: under its own id, or where most of its pixels are."""
    before, after, count = given.index.flatten().long(), regions.index.flatten().long(), regions.num_regions
    into = regions.index_of(given.ids)
    pairs, shared = (before * count + after).unique(return_counts=True)
    most = torch.zeros_like(into).scatter_reduce_(0, pairs // count, shared, "amax")
    largest = pairs[(shared == most[pairs // count]) & (into[pairs // count] < 0)]
    into[largest // count] = largest % count
    return int((into.index_select(0, before) != after).sum())
