"""What a scene decoder says of itself."""

from __future__ import annotations

import json
from collections.abc import Sequence
from importlib.metadata import version

from kcgs.functional import RegionMap
from kcgs.nn import GaussianField

from .groups import Group
from .lists import Entries, Tiles

FORMAT = "kcgs.decoder"
FORMAT_VERSION = "1"


def describe(
    field: GaussianField,
    regions: RegionMap | None,
    tiles: Tiles,
    groups: Sequence[Group],
    entries: Entries,
    *,
    recipe: str,
    cutoff: float,
    clamp: bool,
) -> dict[str, str]:
    """Collect the facts, what was left out among them."""
    count = 1 if regions is None else regions.num_regions
    ids = [0] if regions is None else regions.ids.tolist()
    kind = "none" if count == 1 else "hard" if regions is None or regions.softness == 0.0 else "soft"
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "kind": "scene",
        "kcgs_version": version("kcgs"),
        "recipe": recipe,
        "height": str(field.size[0]),
        "width": str(field.size[1]),
        "channels": str(field.colors.shape[-1]),
        "num_gaussians": str(len(field)),
        "num_regions": str(count),
        "region_ids": json.dumps(ids),
        "contours": kind,
        "cutoff": f"{cutoff:g}",
        "clamp": json.dumps(clamp),
        "left_out": json.dumps(_left_out(field, kind, tiles, groups, entries, clamp)),
    }


def _left_out(
    field: GaussianField, kind: str, tiles: Tiles, groups: Sequence[Group], entries: Entries, clamp: bool
) -> list[str]:
    total = tiles.rows * tiles.cols
    drawn = sum(len(group.tiles) for group in groups)
    unseen = len(field) - len(entries.gaussian.unique())
    said = []
    if kind == "none":
        said.append("regions: the scene has one")
    else:
        said.append(f"memberships in {total - len(tiles.windows)} of {total} tiles, which have one region")
    if kind == "hard":
        said.append("soft weights: contours are hard")
    if not clamp:
        said.append("the clip to [0, 1]")
    if field.opacities is not None:
        said.append("opacities: merged into the colours")
    if unseen:
        said.append(f"{unseen} Gaussians that touch no pixel")
    if drawn < total:
        said.append(f"{total - drawn} tiles that nothing touches")
    said.append(
        f"all but {100 * len(entries.tile) / max(1, total * len(field)):.2g} % of the pairs of Gaussian and tile"
    )
    return said
