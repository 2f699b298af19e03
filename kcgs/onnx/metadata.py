"""The metadata that both decoders write and `describe_decoder` reads, and the doc string of the image."""

from __future__ import annotations

import json
from importlib.metadata import version

import onnx

from kcgs.scene import Scene

FORMAT = "kcgs.decoder"
FORMAT_VERSION = "1"
_CHANNELS = {1: "grey", 3: "red, green, blue"}


def describe_decoder(model: onnx.ModelProto) -> dict[str, object]:
    """Read the metadata of a decoder.

    Args:
        model: made by :func:`kcgs.onnx.scene_decoder` or :func:`kcgs.onnx.generic_decoder`.

    Returns:
        The metadata by name, as strings; the region ids as a list.

    Example:
        >>> from kcgs import GaussianField
        >>> from kcgs.onnx import scene_decoder
        >>> model = scene_decoder(Scene(GaussianField.random(10, (32, 48), seed=0)))
        >>> describe_decoder(model)["num_gaussians"]
        '10'
    """
    metadata: dict[str, object] = {entry.key: entry.value for entry in model.metadata_props}
    if "region_ids" in metadata:
        metadata["region_ids"] = json.loads(str(metadata["region_ids"]))
    return metadata


def decoder_metadata(kind: str, cutoff: float, clamp: bool) -> dict[str, str]:
    """Return the metadata of every decoder."""
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "kind": kind,
        "kcgs_version": version("kcgs"),
        "cutoff": f"{cutoff:g}",
        "clamp": json.dumps(clamp),
    }


def scene_metadata(scene: Scene, *, cutoff: float, clamp: bool) -> dict[str, str]:
    """Return the metadata of a scene's decoder."""
    field, regions = scene.field, scene.regions
    count = 1 if regions is None else regions.num_regions
    contours = "none" if regions is None or count == 1 else "hard" if regions.softness == 0.0 else "soft"
    return {
        **decoder_metadata("scene", cutoff, clamp),
        "recipe": scene.metadata.get("recipe", ""),
        "height": str(field.size[0]),
        "width": str(field.size[1]),
        "channels": str(field.colors.shape[-1]),
        "num_gaussians": str(field.num_gaussians),
        "num_regions": str(count),
        "region_ids": json.dumps([0] if regions is None else regions.ids.tolist()),
        "contours": contours,
    }


def image_doc(channels: int | None, clamp: bool) -> str:
    """Describe the output: order of its axes, channels, range."""
    names = _CHANNELS.get(channels or 0, "in the order of the scene's colours")
    limits = "clipped to [0, 1]" if clamp else "not clipped: it may go below 0 and above 1"
    return f"float32 (1, channels, height, width); channels: {names}; 0 is black, 1 white; {limits}"
