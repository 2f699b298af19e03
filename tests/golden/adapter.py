"""The library as the golden cases call it: where an API changes, this file changes, and no recorded value does."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import onnx
import onnxruntime
import torch
from torch import Tensor

import kcgs
from kcgs import GaussianField, RegionMap, Scene, editing, segment
from kcgs import functional as F
from kcgs.codec import decode, encode
from kcgs.fitting import fit, propose_gaussians
from kcgs.fitting.contour_moves import refine_contours
from kcgs.functional.contour_fit import contour_gain
from kcgs.onnx import generic_decoder, scene_decoder
from kcgs.pruning import prune
from kcgs.rate import compress, fit_bytes
from kcgs.video import fit_video, interpolate

Softness = float | dict[tuple[int, int], float]


class Parts(NamedTuple):
    """A scene as the cases make it: Gaussians, and a label map or None."""

    means: Tensor
    cholesky: Tensor
    colors: Tensor
    ids: Tensor | None = None
    labels: Tensor | None = None
    size: tuple[int, int] = (0, 0)
    softness: Softness = 0.0
    opacities: Tensor | None = None


def _regions(p: Parts) -> RegionMap | None:
    return None if p.labels is None else RegionMap(p.labels, p.softness)


def _scene(p: Parts, metadata: dict[str, str] | None = None) -> Scene:
    field = GaussianField(p.means, p.cholesky, p.colors, p.ids, p.opacities, size=p.size)
    return Scene(field, _regions(p), metadata)


def _of_map(regions: RegionMap | None) -> dict[str, Any]:
    if regions is None:
        return {"labels": None}
    softness = regions.softness if isinstance(regions.softness, float) else sorted(regions.softness.items())
    return {"labels": regions.labels, "softness": softness}


def _of(scene: Scene) -> dict[str, Any]:
    field = scene.field
    tensors = {"means": field.means, "cholesky": field.cholesky, "colors": field.colors}
    return {**tensors, "ids": field.region_ids, "opacities": field.opacities, **_of_map(scene.regions)}


def run_fit(image: Tensor, p: Parts | None, num_gaussians: int, recipe: str, **settings: Any) -> dict[str, Any]:
    """Fit an image with the map of `p`."""
    result = fit(image, None if p is None else _regions(p), num_gaussians, recipe=recipe, seed=3, **settings)
    history = [[e.iteration, e.loss, e.psnr, e.ef_psnr, e.num_gaussians] for e in result.history]
    return {
        **_of(result.scene),
        "history": torch.tensor(history, dtype=torch.float64),
        "stop": result.stop_reason,
        "removed": result.num_pruned,
        "change": result.prune_error,
    }


def run_resumed(
    image: Tensor, p: Parts | None, num_gaussians: int, recipe: str, *, stop: int, **settings: Any
) -> dict[str, Any]:
    """Fit an image, stop after `stop` iterations, and resume from the checkpoint."""
    with tempfile.TemporaryDirectory() as folder:
        settings["checkpoint"] = Path(folder) / "fit.pt"
        run_fit(image, p, num_gaussians, recipe, on_step=lambda iteration, entry: iteration == stop, **settings)
        return run_fit(image, p, num_gaussians, recipe, resume=True, **settings)


def run_fit_video(
    frames: list[Tensor], p: Parts | None, num_gaussians: int, recipe: str, **settings: Any
) -> dict[str, Any]:
    """Fit a video with the map of its first frame, and interpolate between the last two frames."""
    labels = None if p is None else _regions(p)
    scenes = fit_video(frames, labels, num_gaussians, recipe=recipe, seed=3, **settings)
    return {"frames": _of(scenes), "between": _of(interpolate(scenes, len(frames) - 1.5))}


def to_file(p: Parts, **settings: Any) -> bytes:
    """Encode a scene as `.kcgs`."""
    return encode(_scene(p), **settings)


def from_file(data: bytes, **settings: Any) -> dict[str, Any]:
    """Decode `.kcgs`."""
    decoded = decode(data, **settings)
    return {**_of(decoded.scene), "layers": (decoded.layers, decoded.num_layers)}


def run_compress(p: Parts, image: Tensor, **settings: Any) -> bytes:
    """Encode a scene with an eye on its image."""
    return compress(_scene(p), image, seed=3, **settings).data


def run_fit_bytes(image: Tensor, p: Parts | None, target_bytes: int, recipe: str, **settings: Any) -> dict[str, Any]:
    """Fit an image to a number of bytes."""
    result = fit_bytes(image, None if p is None else _regions(p), target_bytes, recipe=recipe, seed=3, **settings)
    return {"data": result.data, **_of(result.scene)}


def saved(p: Parts, metadata: dict[str, str] | None = None) -> tuple[bytes, dict[str, Any]]:
    """Save a scene as `.safetensors`; return the file, and what it loads as."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.safetensors"
        kcgs.save(path, _scene(p, metadata))
        scene = kcgs.load(path)
        return path.read_bytes(), {**_of(scene), "metadata": scene.metadata}


def decoder_of(p: Parts, **settings: Any) -> onnx.ModelProto:
    """Build the ONNX decoder of one scene."""
    metadata = {"recipe": settings.pop("recipe")} if "recipe" in settings else None
    return scene_decoder(_scene(p, metadata), **{"clamp": False, **settings})


def decoder_of_any(**settings: Any) -> onnx.ModelProto:
    """Build the generic ONNX decoder."""
    return generic_decoder(**{"clamp": False, **settings})


def run_onnx(model: onnx.ModelProto, feeds: dict[str, Any]) -> Tensor:
    """Run a decoder on one thread."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
    return torch.from_numpy(session.run(["image"], {k: np.asarray(v) for k, v in feeds.items()})[0])


def splat(p: Parts, **settings: Any) -> Tensor:
    """Evaluate the splat of tensors that may hold gradients; `size` is that of the map."""
    regions = _regions(p)
    return F.region_splat(p.means, p.cholesky, p.colors, None if regions is None else p.ids, regions, **settings)


def render(p: Parts, size: tuple[int, int] | None = None) -> Tensor:
    """Render a scene as a viewer shows it."""
    return _scene(p).render(size)


def resized_map(p: Parts, size: tuple[int, int]) -> dict[str, Any]:
    """Return a map at another size."""
    regions = _regions(p)
    assert regions is not None
    return _of_map(regions.resize(size))


def run_segment(image: Tensor, method: str, **options: Any) -> Tensor:
    """Run a segmenter by name."""
    return segment.segment(image, method, **options)


def cleanups(image: Tensor, labels: Tensor) -> dict[str, Tensor]:
    """What cleans a label map, each by itself."""
    return {
        name: segment.Cleanup(**{"min_size": 1, "connected": False, **options}).apply(image, labels).labels
        for name, options in {
            "connected": {"connected": True},
            "by-area": {},
            "specks": {"min_size": 20},
            "similar": {"connected": True, "max_regions": 3},
            "snap": {"snap": 2},
        }.items()
    }


def contour_functions(image: Tensor, labels: Tensor) -> dict[str, Any]:
    """What is measured on and done to contours."""
    return {
        "widths": sorted(F.choose_softness(image, labels).items()),
        "gain": sorted((pair, tuple(gain)) for pair, gain in contour_gain(image, labels).items()),
        "merge": F.merge_regions(image, labels),
        "merge-dear": F.merge_regions(image, labels, 0.05),
        "band": F.edge_band(labels),
    }


def metrics(image: Tensor, other: Tensor, labels: Tensor) -> dict[str, Tensor]:
    """Every metric of a pair of images."""
    plain = {name: getattr(F, name)(image, other) for name in ("psnr", "ssim", "ms_ssim")}
    return plain | {name: getattr(F, name)(image, other, labels) for name in ("ef_psnr", "ef_ssim")}


def edits(p: Parts, region: int, background: Tensor) -> dict[str, Any]:
    """Every edit of one region."""
    scene = _scene(p)
    larger = (2 * p.size[0], 2 * p.size[1])
    return {
        "move": _of(editing.move_region(scene, region, (3, -2), fill=False)),
        "delete": _of(editing.delete_region(scene, region, fill=False)),
        "recolor": _of(editing.recolor_region(scene, region, torch.tensor([0.5, 1.0, 1.5]), 0.1)),
        "extract": editing.render_region(scene, region, clamp=False),
        "extract-larger": editing.render_region(scene, region, larger, clamp=False),
        "background": editing.render_over(scene, [region], background),
    }


def run_prune(p: Parts, tolerance: float) -> dict[str, Any]:
    """Prune a scene."""
    pruned = prune(_scene(p), tolerance)
    return {**_of(pruned.scene), "removed": pruned.num_pruned, "change": pruned.prune_error}


def run_propose(p: Parts, residual: Tensor, count: int) -> tuple[Any, ...]:
    """Find Gaussians to add."""
    field = propose_gaussians(residual, count, _regions(p))
    return field.means.detach(), field.cholesky.detach(), field.colors.detach(), field.region_ids


def run_refine_contours(p: Parts, image: Tensor, **settings: Any) -> dict[str, Any]:
    """Move contours."""
    return _of_map(refine_contours(_scene(p), image, **settings))
