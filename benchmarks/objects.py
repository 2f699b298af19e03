"""How well is an object cut out, by itself or by a box and clicks?"""

from __future__ import annotations

import math
import time
from itertools import product
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, label

from kcgs.data import Davis
from kcgs.segment import segment_with_scores

from .core.figures import Panel, save_lines
from .core.images import load
from .core.run import Job, Options, Page, Row
from .core.tables import group_by, means_table

# the segmenter, and whether it gets a box
METHODS = {"grabcut, box": ("grabcut", True), "object": ("object", False), "object, box": ("object", True)}
NUM_CLICKS = 4
# share of the mask's sides by which a box is larger on each side
MARGIN = 0.05
# least overlap (IoU) with the mask of a good result
GOOD = 0.9
# overlap below which a result is a failure
BAD = 0.5
METHOD = f"""First frames of DAVIS with their masks. The box is that of the mask, larger by {MARGIN:.0%} on each side.
Each click is in the middle of the largest wrong area, on its pixel that is farthest from the border. IoU is the overlap
with the mask, intersection over union; *good* is the share of frames with at least {GOOD}, *failed* that below {BAD}.
`object` is the network ISNet, its default."""

Mask = NDArray[np.bool_]


def box_of(mask: Mask) -> list[int]:
    """Return left, top, right and bottom around a mask."""
    y, x = (places.tolist() for places in mask.nonzero())
    edges = []
    for values, size in ((x, mask.shape[1]), (y, mask.shape[0])):
        low, high = min(values), max(values) + 1
        margin = MARGIN * (high - low)
        edges.append((max(0, math.floor(low - margin)), min(size, math.ceil(high + margin))))
    (left, right), (top, bottom) = edges
    return [left, top, right, bottom]


def next_click(mask: Mask, truth: Mask) -> tuple[str, list[int]] | None:
    """Return "foreground" or "background" and the (x, y) of the next click; None if no pixel is wrong."""
    areas = []
    for name, wrong in (("foreground", truth & ~mask), ("background", mask & ~truth)):
        pieces = label(wrong)[0]
        sizes = np.bincount(pieces.ravel())[1:]
        if len(sizes):
            areas.append((int(sizes.max()), name, pieces == sizes.argmax() + 1))
    if not areas:
        return None
    _, name, piece = max(areas, key=lambda area: area[0])
    depth = distance_transform_edt(np.pad(piece, 1))[1:-1, 1:-1]
    y, x = np.unravel_index(depth.argmax(), depth.shape)
    return name, [int(x), int(y)]


def measure(image: str, method: str, data: str, quick: bool) -> list[Row]:
    """Cut out the object of a frame with 0, 1, 2 ... clicks."""
    pixels, masks = load(image, data, quick)
    assert masks is not None
    truth, rows = masks.numpy() > 0, []
    segmenter, has_box = METHODS[method]
    prompt = {"box": box_of(truth)} if has_box else {}
    clicks: dict[str, list[list[int]]] = {"foreground": [], "background": []}
    for number in range(NUM_CLICKS + 1):
        start = time.process_time()
        labels, _, names = segment_with_scores(pixels, segmenter, **prompt, **clicks)
        seconds = time.process_time() - start
        ids = [region for region, name in (names or {}).items() if name == "object"]
        mask = torch.isin(labels, torch.tensor(ids)).numpy()
        iou = float((mask & truth).sum() / (mask | truth).sum())
        rows.append(
            {
                "image": image, "method": method, "clicks": number, "iou": iou, "good": float(iou >= GOOD),
                "failed": float(iou < BAD), "core_seconds": seconds,
            }
        )  # fmt: skip
        if (click := next_click(mask, truth)) is not None:
            clicks[click[0]].append(click[1])
    return rows


def jobs(options: Options) -> list[Job]:
    """List the frames by each method; in the quick form a disc by GrabCut, which takes no network."""
    methods, images = list(METHODS), ["disc"]
    if options.quick:
        methods = methods[:1]
    else:
        images = [frame.sequence for frame in Davis(options.folder() / "DAVIS")]
    return [
        {"image": image, "method": method, **options.image_arguments()} for image, method in product(images, methods)
    ]


def page(folder: Path, rows: list[Row]) -> Page:
    """Write the report."""
    save_lines(folder / "objects.png", [Panel("", rows, "clicks", "iou", ("linear", "linear"))], "method", "clicks")
    sentences, losses = [], []
    for (method, number), group in group_by(rows, ["method", "clicks"]).items():
        overlaps = {row["image"]: row["iou"] for row in group}
        if number in (0, NUM_CLICKS):
            sentences.append(f"`{method}` and {number} clicks: mean IoU {np.mean(list(overlaps.values())):.2f}.")
        if failures := ", ".join(image for image, iou in overlaps.items() if iou < BAD):
            losses.append(f"- `{method}` and {number} clicks, below {BAD}: {failures}")
    table = means_table(rows, ["method", "clicks"], "", ("iou", "good", "failed", "core_seconds"))
    return Page(" ".join(sentences), "objects.png", table, "\n".join(losses), METHOD)
