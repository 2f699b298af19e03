"""What a decoder says of itself."""

from __future__ import annotations

import json
from collections.abc import Sequence
from importlib.metadata import version

import onnx

from kcgs.functional import RegionMap
from kcgs.nn import GaussianField

from .groups import Group
from .lists import Entries, Tiles

FORMAT = "kcgs.decoder"
FORMAT_VERSION = "1"
_LISTS = ("region_ids", "left_out")


def header(kind: str, cutoff: float, clamp: bool) -> dict[str, str]:
    """Facts of every decoder."""
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "kind": kind,
        "kcgs_version": version("kcgs"),
        "cutoff": f"{cutoff:g}",
        "clamp": json.dumps(clamp),
    }


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
        **header("scene", cutoff, clamp),
        "recipe": recipe,
        "height": str(field.size[0]),
        "width": str(field.size[1]),
        "channels": str(field.colors.shape[-1]),
        "num_gaussians": str(len(field)),
        "num_regions": str(count),
        "region_ids": json.dumps(ids),
        "contours": kind,
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


def describe_decoder(model: onnx.ModelProto) -> dict[str, object]:
    """Read what a decoder says of itself.

    Args:
        model: made by :func:`kcgs.onnx.scene_decoder` or :func:`kcgs.onnx.generic_decoder`.

    Returns:
        The metadata; lists as lists.

    Example:
        >>> from kcgs.onnx import scene_decoder
        >>> model = scene_decoder(GaussianField.random(10, (32, 48), seed=0))
        >>> describe_decoder(model)["num_gaussians"]
        '10'
    """
    entries = {entry.key: entry.value for entry in model.metadata_props}
    return {key: json.loads(value) if key in _LISTS else value for key, value in entries.items()}
