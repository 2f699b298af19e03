"""What a decoder says of itself."""

from __future__ import annotations

import json
from importlib.metadata import version

import onnx

from kcgs.scene import Scene

from .layout import Layout

FORMAT = "kcgs.decoder"
FORMAT_VERSION = "1"
_LISTS = ("region_ids", "left_out")
_CHANNELS = {1: "grey", 3: "red, green, blue"}


def image_doc(channels: int | None, clamp: bool) -> str:
    """Say what an image is: order of its axes, channels, range."""
    names = _CHANNELS.get(channels or 0, "in the order of the scene's colours")
    limits = "clipped to [0, 1]" if clamp else "not clipped: it may go below 0 and above 1"
    return f"float32 (1, channels, height, width); channels: {names}; 0 is black, 1 white; {limits}"


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


def describe(scene: Scene, layout: Layout, *, cutoff: float, clamp: bool, crisp: bool) -> dict[str, str]:
    """Collect the facts, what was left out among them."""
    field, regions = scene.field, scene.regions
    count = 1 if regions is None else regions.num_regions
    contours = "none" if count == 1 else "hard" if regions is None or regions.softness == 0.0 else "soft"
    contours = "crisp" if crisp and count > 1 else contours
    return {
        **header("scene", cutoff, clamp),
        "recipe": scene.metadata.get("recipe", ""),
        "height": str(field.size[0]),
        "width": str(field.size[1]),
        "channels": str(field.colors.shape[-1]),
        "num_gaussians": str(field.num_gaussians),
        "num_regions": str(count),
        "region_ids": json.dumps([0] if regions is None else regions.ids.tolist()),
        "contours": contours,
        "left_out": json.dumps(_left_out(scene, contours, layout, clamp)),
    }


def _left_out(scene: Scene, contours: str, layout: Layout, clamp: bool) -> list[str]:
    total, windows = len(layout.tiles.regions), len(layout.tiles.windows)
    touched = sum(len(group.tiles) for group in layout.groups)
    unseen = scene.num_gaussians - len(layout.gaussians.means)
    pairs = sum(int(group.lengths.sum()) for group in layout.groups)
    one_region = f"memberships in {total - windows} of {total} tiles, which have one region"
    facts = {
        "regions: the scene has one": contours == "none",
        one_region: contours != "none",
        "soft weights: contours are hard": contours == "hard",
        "coarse grids: too few Gaussians are wide": layout.nodes is None,
        "the clip to [0, 1]": not clamp,
        "opacities: merged into the colours": scene.field.opacities is not None,
        f"{unseen} Gaussians that touch no pixel": unseen > 0,
        f"{total - touched} tiles that nothing touches": touched < total,
        f"all but {100 * pairs / max(1, total * scene.num_gaussians):.2g} % of the pairs of Gaussian and tile": True,
    }
    return [fact for fact, holds in facts.items() if holds]


def describe_decoder(model: onnx.ModelProto) -> dict[str, object]:
    """Read what a decoder says of itself.

    Args:
        model: made by :func:`kcgs.onnx.scene_decoder` or :func:`kcgs.onnx.generic_decoder`.

    Returns:
        The metadata; lists as lists.

    Example:
        >>> from kcgs import GaussianField
        >>> from kcgs.onnx import scene_decoder
        >>> model = scene_decoder(Scene(GaussianField.random(10, (32, 48), seed=0)))
        >>> describe_decoder(model)["num_gaussians"]
        '10'
    """
    entries = {entry.key: entry.value for entry in model.metadata_props}
    return {key: json.loads(value) if key in _LISTS else value for key, value in entries.items()}
