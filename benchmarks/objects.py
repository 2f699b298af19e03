"""How well does a box with a few clicks cut out an object? `python -m benchmarks.objects DATA/DAVIS` prints a table.

The box is that of the mask, larger by 5 % on each side. Each click is in the middle of the largest wrong area: the
pixel of it that is farthest from its border.
"""

from __future__ import annotations

import argparse
import math
import time
from statistics import fmean

import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track
from scipy.ndimage import distance_transform_edt, label

from kcgs.data import Davis
from kcgs.segment import segment_with_scores

from .core.compare import markdown

NUM_CLICKS = 4
# by which a box is larger than the mask, on each side
MARGIN = 0.05

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
    """Return foreground or background, and (x, y) of a click; None where all is right."""
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


def main() -> None:
    """Cut out the object of each first frame."""
    parser = argparse.ArgumentParser("python -m benchmarks.objects", description=__doc__)
    parser.add_argument("davis", help="folder with JPEGImages and Annotations in it")
    parser.add_argument("--method", default="grabcut", help="grabcut or sam")
    options = parser.parse_args()
    overlaps: list[list[float]] = [[] for _ in range(NUM_CLICKS + 1)]
    seconds: list[list[float]] = [[] for _ in range(NUM_CLICKS + 1)]
    davis = Davis(options.davis)
    for frame in track(davis, total=len(davis)):
        truth = frame.labels.numpy() > 0
        clicks: dict[str, list[list[int]]] = {"foreground": [], "background": []}
        box = box_of(truth)
        for number in range(NUM_CLICKS + 1):
            start = time.process_time()
            labels, _, names = segment_with_scores(frame.image, options.method, box=box, **clicks)
            seconds[number].append(time.process_time() - start)
            ids = [region for region, name in (names or {}).items() if name == "object"]
            mask = torch.isin(labels, torch.tensor(ids)).numpy()
            overlaps[number].append(float((mask & truth).sum() / (mask | truth).sum()))
            click = next_click(mask, truth)
            if click is not None:
                clicks[click[0]].append(click[1])
        print(frame.sequence, " ".join(f"{values[-1]:.2f}" for values in overlaps))
    lines = [
        [str(number), f"{fmean(values):.2f}", f"{min(values):.2f}", f"{fmean(times):.2f}", f"{max(times):.2f}"]
        for number, (values, times) in enumerate(zip(overlaps, seconds, strict=True))
    ]
    print(markdown(["clicks", "mean IoU", "least IoU", "seconds of a core", "at most"], lines))


if __name__ == "__main__":
    main()
