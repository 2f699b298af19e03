"""The decoders that are raced: from files on disk to a function that draws."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcgs.functional import RegionMap, region_splat
from kcgs.io import load, save
from kcgs.nn import GaussianField
from kcgs.onnx import generic_decoder, scene_decoder, write_model

from .scenes import Scene

SCENE, GENERIC, CPU, TILED = "onnxruntime, scene", "onnxruntime, generic", "torch, cpu", "torch, tiled"
DECODERS = (SCENE, GENERIC, CPU, TILED)
YARDSTICK = CPU
# the truth: what it leaves out of a sum is far below float32's rounding
TRUTH_CUTOFF = 1e-12

Draw = Callable[[], Tensor]


class Files(NamedTuple):
    """What a decoder reads, and the cutoff that it was, or is, given."""

    scene: Path
    decoder: Path
    generic: Path
    cutoff: float


class Placed(NamedTuple):
    """A scene as it is at one size."""

    means: Tensor
    cholesky: Tensor
    colors: Tensor
    region_ids: Tensor | None
    regions: RegionMap | None
    size: tuple[int, int]


def write_files(folder: Path, scene: Scene, cutoff: float) -> Files:
    """Write a scene and its decoders into a folder, which is made."""
    folder.mkdir(parents=True)
    files = Files(folder / "scene.safetensors", folder / "scene.onnx", folder / "generic.onnx", cutoff)
    save(files.scene, scene.field, scene.regions)
    write_model(scene_decoder(scene.field, scene.regions, cutoff=cutoff), files.decoder)
    write_model(generic_decoder(cutoff=cutoff), files.generic)
    return files


def can_draw(name: str, scene: Scene) -> bool:
    """Whether a decoder draws this scene: the generic one has hard contours only, of one label a pixel."""
    if name != GENERIC or scene.regions is None:
        return True
    return scene.regions.softness == 0.0 and scene.regions.supersample == 1


def place(field: GaussianField, regions: RegionMap | None, size: tuple[int, int]) -> Placed:
    """Scale the Gaussians and sample the map anew: once, for all pictures of that size."""
    down, across = size[0] / field.size[0], size[1] / field.size[1]
    means, cholesky, colors = (t.detach() for t in (field.means, field.cholesky, field.merged_colors()))
    return Placed(
        means * means.new_tensor([across, down]),
        cholesky * cholesky.new_tensor([across, down, down]),
        colors,
        None if regions is None else field.region_ids,
        None if regions is None else regions.resize(size),
        size,
    )


def open_decoder(name: str, files: Files, size: tuple[int, int], threads: int) -> Draw:
    """Read the files and return what draws (C, H, W) at that size.

    Args:
        name: among `DECODERS`.
        files: of the scene.
        size: (height, width).
        threads: of onnxruntime; torch draws on as many as it is told to use.
    """
    if name == SCENE:
        session, feeds = _session(files.decoder, threads), {"size": np.array(size, np.int64)}
        return lambda: torch.from_numpy(session.run(["image"], feeds)[0])[0]
    field, regions, _ = load(files.scene)
    placed = place(field, regions, size)
    if name == GENERIC:
        session, numbers = _session(files.generic, threads), _generic_feeds(placed)
        return lambda: torch.from_numpy(session.run(["image"], numbers)[0])[0]
    backend = {CPU: "cpu", TILED: "tiled"}[name]
    return lambda: splat(placed, files.cutoff, backend)


def splat(placed: Placed, cutoff: float, backend: str) -> Tensor:
    """Draw by one of torch's kernels, without gradients."""
    with torch.inference_mode():
        return region_splat(*placed[:5], size=placed.size, cutoff=cutoff, backend=backend)


def truth(scene: Scene, size: tuple[int, int], *, dense: bool = False) -> Tensor:
    """Draw in float64: tile by tile at a cutoff next to nothing, or the whole dense sum of the reference."""
    field = scene.field
    means, cholesky, colors = (t.detach().double() for t in (field.means, field.cholesky, field.colors))
    opacities = None if field.opacities is None else field.opacities.detach().double()
    exact = GaussianField(means, cholesky, colors, field.region_ids, opacities, size=field.size)
    placed = place(exact, scene.regions, size)
    return splat(placed, 0.0, "reference") if dense else splat(placed, TRUTH_CUTOFF, "tiled")


def _session(path: Path, threads: int) -> Any:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    # idle threads would go on spinning while the next decoder is timed
    options.add_session_config_entry("session.force_spinning_stop", "1")
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def _generic_feeds(placed: Placed) -> dict[str, Any]:
    labels, ids = torch.zeros(placed.size, dtype=torch.int64), torch.zeros(len(placed.means), dtype=torch.int64)
    if placed.regions is not None and placed.region_ids is not None:
        labels, ids = placed.regions.labels, placed.region_ids
    tensors = dict(zip(("means", "cholesky", "colors"), placed[:3], strict=True)) | {"region_ids": ids}
    return {name: tensor.numpy() for name, tensor in (tensors | {"labels": labels}).items()}
