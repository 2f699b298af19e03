"""How well are the holes filled that deleted and moved objects leave?"""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn.functional import pad

from kcgs import fit
from kcgs.data import load_image, save_image
from kcgs.editing import delete_region, move_region

from .core.compare import Comparison, losses_table
from .core.figures import save_rows
from .core.fits import QUICK_ITERATIONS
from .core.images import load, names
from .core.run import Job, Options, Page, Row
from .core.tables import means_table, values_of

NUM_GAUSSIANS = 3_000
QUICK_GAUSSIANS = 60
FILLS = {"not filled": False, "filled": True}
# width of the ring around the edit whose gradients are the standard for a steep pixel, in pixels
RING = 40
# width of the margin around a moved object that is not measured, in pixels
CONTOUR = 2
# width of the surroundings of an edit in the figure, in pixels
FIGURE_MARGIN = 45
QUANTITIES = ("steep", "beyond [0, 1]")
COMPARISON = Comparison("filled", "not filled")
METHOD = f"""The object of each frame of DAVIS is deleted, and moved to the side by a third of its width, away from
the nearer border. Figures are of the pixels that are uncovered; those within {CONTOUR} pixels of a moved object are
left out. A pixel is steep whose gradient is above the 99.9th percentile of the {RING} pixels around; *steepest* is a
multiple of that. The figure shows, for each edit, the scene, the edit without filling, and filled. By eye, fills of
grass, water and roads pass; those of crowds and of rails are sharp, and repeat parts: people, a piece of track."""


def measure(image: str, edit: str, n: int, folder: str, data: str, quick: bool) -> list[Row]:
    """Edit a scene with and without filling, and write both renders beside the scene."""
    pixels, labels = load(image, data, quick)
    assert labels is not None
    settings: dict[str, Any] = {"iterations": QUICK_ITERATIONS, "merge_regions": False} if quick else {}
    scene = fit(pixels, labels, n, **settings).scene
    assert scene.regions is not None
    ids = [region for region in scene.regions.ids.tolist() if region != 0]
    hole = torch.isin(scene.regions.labels, torch.tensor(ids))
    apply, covered, uncovered = partial(delete_region, scene, ids), hole, hole
    if edit == "move":
        columns = hole.any(0).nonzero().flatten().tolist()
        left, width = columns[0], columns[-1] + 1 - columns[0]
        step = max(1, round(width / 3)) * (1 if 2 * left + width <= hole.shape[1] else -1)
        landing = pad(hole, (step, -step))
        apply, covered = partial(move_region, scene, ids, (step, 0)), hole | landing
        uncovered = hole & ~dilate(landing, CONTOUR)
    around, images, rows = dilate(covered, RING) & ~covered, [scene.render()], []
    for method, fill in FILLS.items():
        start = time.process_time()
        edited = apply(fill=fill)
        seconds, values = time.process_time() - start, edited().detach()
        slopes = torch.stack(torch.gradient(values.double(), dim=(1, 2))).norm(dim=0).amax(0)
        slope, colors = slopes[uncovered] / slopes[around].quantile(0.999), values[:, uncovered]
        rows.append({
            "image": image, "edit": edit, "method": method, "pixels": len(slope), "steep": int((slope > 1).sum()),
            "steepest": float(slope.max()),
            "beyond [0, 1]": float(torch.maximum(-colors, colors - 1).clamp_min(0).max()),
            "core_seconds": seconds, "added": edited.num_gaussians - scene.num_gaussians,
        })  # fmt: skip
        images.append(edited.render())
    area = dilate(covered, FIGURE_MARGIN)
    details = [image[:, area.any(1)][..., area.any(0)] for image in images]
    Path(folder).mkdir(parents=True, exist_ok=True)
    save_image(Path(folder, f"{image}-{edit}.png"), torch.cat(details, 2))
    return rows


def dilate(mask: Tensor, pixels: int) -> Tensor:
    """Return the pixels at most `pixels` away from a mask."""
    return torch.from_numpy(distance_transform_edt(~mask.numpy()) <= pixels)


def jobs(options: Options) -> list[Job]:
    """List the edits of frames of DAVIS."""
    images = ["disc"] if options.quick else list(options.only) or names(options.folder(), "davis")
    n = QUICK_GAUSSIANS if options.quick else NUM_GAUSSIANS
    arguments = {"n": n, "folder": str(options.output / "runs"), **options.image_arguments()}
    return [{"image": image, "edit": edit, **arguments} for edit in ("delete", "move") for image in images]


def page(folder: Path, rows: list[Row]) -> Page:
    """Write the report; if the images of the run are gone, keep the old figure."""
    paths = {folder / "runs" / f"{row['image']}-{row['edit']}.png": 0 for row in rows}
    sheet = [[load_image(path)] for path in paths if path.is_file()]
    if sheet:
        save_rows(folder / "fill.jpg", sheet)
    filled, bare = ([row for row in rows if row["method"] == method] for method in ("filled", "not filled"))
    steep = [100 * sum(values_of(part, "steep")) / sum(values_of(part, "pixels")) for part in (filled, bare)]
    beyond = max(values_of(filled, "beyond [0, 1]"))
    answer = (
        f"Gradients stronger than those around cover {steep[0]:.2f} % of filled holes, and {steep[1]:.2f} % of holes "
        f"that are left. Filling takes {fmean(values_of(filled, 'core_seconds')):.1f} seconds of a core, and no "
        f"value is more than {beyond:.2f} beyond [0, 1]."
    )
    columns = ("pixels", *QUANTITIES, "steepest", "core_seconds", "added")
    table = means_table(rows, ["edit", "method"], "", columns)
    losses = losses_table(rows, [COMPARISON], QUANTITIES, ["edit"])
    return Page(answer, "fill.jpg", table, losses, METHOD)
