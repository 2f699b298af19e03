"""Make the conformance cases of this folder: `python make.py`, with kcgs installed.

Everything is made by rule, so that the same files come out each time.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import onnx
import torch
from torch import Tensor

from kcgs import GaussianField, RegionMap, RegionSplatRenderer, Scene
from kcgs.maps import membership_at, table_and_size
from kcgs.onnx import scene_decoder

Array = np.ndarray[Any, Any]

SIZE = (20, 34)
CUTOFF = 1e-4
# enlarged and reduced, by another factor across than down and no whole one
OTHER_SIZES = ((24, 41), (11, 17))
# the view is a cut of the image enlarged ZOOM times, whole pixels of it: (left, top, right, bottom)
ZOOM = 4
CUT = (61, 42, 79, 56)
_IRRATIONAL = (2, 3, 5, 7, 11, 13, 17, 19, 23, 29)


class Case(NamedTuple):
    """The map of a scene, and what its Gaussians are."""

    ids: tuple[int, ...] = ()
    softness: float | Mapping[tuple[int, int], float] = 0.0
    needle: bool = False  # also four channels and opacities
    hidden: int = 1  # index of the region that `image_visible` hides


CASES = {
    "plain": Case(),
    "hard": Case((2, 5, 300)),
    "soft": Case((0, 1, 7), 0.8, hidden=2),
    "pairs": Case((2, 5, 9, 11), {(2, 5): 0.0, (5, 9): 1.7, (2, 9): 0.6, (2, 11): 1.0, (9, 11): 0.4}, hidden=0),
    "needle": Case((3, 4), needle=True),
}


def uniform(count: int, columns: int, seed: int) -> Tensor:
    """Spread numbers evenly over [0, 1) by multiples of roots: no generator that a library could change."""
    steps = torch.arange(1, count + 1, dtype=torch.float64)[:, None]
    roots = torch.tensor([math.sqrt(_IRRATIONAL[(seed + i) % 10]) for i in range(columns)], dtype=torch.float64)
    return (steps * roots) % 1


def make_labels(ids: tuple[int, ...]) -> Tensor:
    """Label a disc, a diagonal and a bar, as many as there are ids."""
    y, x = torch.meshgrid(*(torch.arange(n) + 0.5 for n in SIZE), indexing="ij")
    index = (x + 0.6 * y > 21.3).long() * (len(ids) > 2)
    index[(x - 12.2) ** 2 + (y - 9.1) ** 2 < 37] = len(ids) - 1
    if len(ids) > 3:
        index[(y - 15.2).abs() < 2.4] = 2
    return torch.tensor(ids)[index]


def make_scene(case: Case) -> Scene:
    """Spread Gaussians of all shapes over the image and beyond its border."""
    regions = RegionMap(make_labels(case.ids), case.softness) if case.ids else None
    count, height, width = 40, *SIZE
    means = uniform(count, 2, 0) * torch.tensor([width + 6.0, height + 6.0]) - 3
    shapes = uniform(count, 3, 2)
    cholesky = (0.4 + 5 * shapes[:, :1] ** 2) * torch.cat([0.4 + shapes[:, 1:], shapes[:, :1] - 0.5], 1)[:, [0, 2, 1]]
    colors = 0.55 * uniform(count, 4 if case.needle else 3, 4) - 0.1
    if case.needle:
        means[0], cholesky[0] = torch.tensor([11.3, 6.7]), torch.tensor([24.0, 9.0, 0.3])
    numbers = [t.float() for t in (means, cholesky, colors)]
    opacities = (0.3 + 0.7 * uniform(count, 1, 7)[:, 0]).float() if case.needle else None
    field = GaussianField(*numbers, opacities=opacities, size=SIZE)
    return Scene(field if regions is None else field.assign_regions(regions), regions)


def render(scene: Scene, size: tuple[int, int], factors: Tensor | None = None) -> Array:
    """Render by the dense sum in float64, rounded to float32 at the end; `factors`, (N,), multiply the colours."""
    field = scene.field
    colors = field.merged_colors().detach().double()
    means, cholesky = field.means.detach().double(), field.cholesky.detach().double()
    if factors is not None:
        colors = colors * factors.double()[:, None]
    exact = GaussianField(means, cholesky, colors, field.region_ids, size=field.size)
    with torch.no_grad():
        image: Tensor = RegionSplatRenderer(cutoff=CUTOFF, backend="reference")(exact, scene.regions, size)
    return image.float().numpy()


def make_arrays(case: Case) -> dict[str, Array]:
    """Collect what NAME.npz holds; README.md says what each array is."""
    scene = make_scene(case)
    field, regions = scene.field, scene.regions
    tensors = {"means": field.means, "cholesky": field.cholesky, "colors": field.colors, "opacities": field.opacities}
    arrays = {name: tensor.detach().numpy() for name, tensor in tensors.items() if tensor is not None}
    arrays |= {"height": np.array(SIZE[0]), "width": np.array(SIZE[1]), "cutoff": np.array(CUTOFF)}
    for size in (SIZE, *OTHER_SIZES):
        arrays[f"image_{size[0]}x{size[1]}"] = render(scene, size)
    left, top, right, bottom = CUT
    large = render(scene, (ZOOM * SIZE[0], ZOOM * SIZE[1]))
    arrays["view"] = np.array(CUT, np.float32) / ZOOM
    arrays["image_view"] = np.ascontiguousarray(large[:, top:bottom, left:right])
    if regions is None or field.region_ids is None:
        return arrays
    for name, tensor in (("region_ids", field.region_ids), ("labels", regions.labels)):
        arrays[name] = tensor.numpy().astype(np.min_scalar_type(int(regions.ids.max())))
    pairs = case.softness
    arrays["softness"] = np.array([(*k, v) for k, v in pairs.items()] if isinstance(pairs, Mapping) else pairs)
    membership = membership_at(*table_and_size(regions))
    if membership.table.width_index is not None:
        # a pixel may be equally near to several contours: other programs need not break the tie as this one does
        arrays["contour_width"] = membership.variances[0].sqrt().float().numpy()
    visible = torch.ones(regions.num_regions)
    visible[case.hidden] = 0
    arrays["visible"] = visible.numpy()
    factors = visible[regions.index_of(field.region_ids)]
    arrays["image_visible"] = render(scene, SIZE, factors)
    return arrays


def make(folder: Path) -> None:
    """Write NAME.npz and NAME.onnx of every case into a folder."""
    for name, case in CASES.items():
        np.savez_compressed(folder / f"{name}.npz", **make_arrays(case))
        model = scene_decoder(make_scene(case), cutoff=CUTOFF, clamp=False, interactive=True)
        onnx.save(model, folder / f"{name}.onnx")


if __name__ == "__main__":
    make(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
