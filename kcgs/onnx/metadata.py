"""What a decoder says of itself."""

from __future__ import annotations

import json
from importlib.metadata import version

import onnx

from kcgs.scene import Scene

FORMAT = "kcgs.decoder"
FORMAT_VERSION = "1"
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


def describe(scene: Scene, *, cutoff: float, clamp: bool, crisp: bool) -> dict[str, str]:
    """Collect the facts of a scene's decoder."""
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
    }


def describe_decoder(model: onnx.ModelProto) -> dict[str, object]:
    """Read what a decoder says of itself.

    Args:
        model: made by :func:`kcgs.onnx.scene_decoder` or :func:`kcgs.onnx.generic_decoder`.

    Returns:
        The metadata; the list of region ids as a list.

    Example:
        >>> from kcgs import GaussianField
        >>> from kcgs.onnx import scene_decoder
        >>> model = scene_decoder(Scene(GaussianField.random(10, (32, 48), seed=0)))
        >>> describe_decoder(model)["num_gaussians"]
        '10'
    """
    facts: dict[str, object] = {entry.key: entry.value for entry in model.metadata_props}
    if "region_ids" in facts:
        facts["region_ids"] = json.loads(str(facts["region_ids"]))
    return facts
