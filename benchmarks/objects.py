"""How well is an object cut out, by itself or by a box and clicks? `python -m benchmarks.objects DATA/DAVIS` says it.

The box is that of the mask, larger by 5 % on each side. Each click is in the middle of the largest wrong area: the
pixel of it that is farthest from its border.
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import dataclass, field
from itertools import product
from statistics import fmean
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track
from scipy.ndimage import distance_transform_edt, label
from torch import Tensor

from kcgs.data import Davis
from kcgs.segment import segment_with_scores

from .core.compare import markdown

NUM_CLICKS = 4
# share of the mask's sides by which a box is larger on each side
MARGIN = 0.05
# least overlap (IoU) with the mask of a good result
GOOD = 0.9
# overlap below which a result is a failure
BAD = 0.5

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


@dataclass
class Way:
    """A method with its options, and its overlaps and seconds for each frame and number of clicks."""

    method: str
    has_box: bool
    options: dict[str, Any] = field(default_factory=dict)
    overlaps: list[list[float]] = field(default_factory=list)
    seconds: list[list[float]] = field(default_factory=list)

    def __str__(self) -> str:
        return f"{self.method}, box" if self.has_box else self.method

    def cut_out(self, image: Tensor, truth: Mask) -> None:
        """Cut out the object of a frame with 0, 1, 2 ... clicks."""
        clicks: dict[str, list[list[int]]] = {"foreground": [], "background": []}
        prompt = {"box": box_of(truth)} if self.has_box else {}
        self.overlaps.append([])
        self.seconds.append([])
        for _ in range(NUM_CLICKS + 1):
            start = time.process_time()
            labels, _, names = segment_with_scores(image, self.method, **self.options, **prompt, **clicks)
            self.seconds[-1].append(time.process_time() - start)
            ids = [region for region, name in (names or {}).items() if name == "object"]
            mask = torch.isin(labels, torch.tensor(ids)).numpy()
            self.overlaps[-1].append(float((mask & truth).sum() / (mask | truth).sum()))
            if (click := next_click(mask, truth)) is not None:
                clicks[click[0]].append(click[1])


def main() -> None:
    """Cut out the object of each first frame."""
    parser = argparse.ArgumentParser("python -m benchmarks.objects", description=__doc__)
    parser.add_argument("davis", help="folder with JPEGImages and Annotations in it")
    parser.add_argument("--model", help="weights of the method object; not given: its own, which are downloaded")
    parser.add_argument("--sam", help="weights of the method sam, which is left out without them")
    options = parser.parse_args()
    weights = {"model": options.model} if options.model else {}
    ways = [Way("grabcut", True), Way("object", False, weights), Way("object", True, weights)]
    if options.sam:
        ways.append(Way("sam", True, {"model": options.sam}))
    davis, frames = Davis(options.davis), []
    for frame in track(davis, total=len(davis)):
        frames.append(frame.sequence)
        for way in ways:
            way.cut_out(frame.image, frame.labels.numpy() > 0)
        print(frame.sequence, "; ".join(" ".join(f"{value:.2f}" for value in way.overlaps[-1]) for way in ways))
    rows = []
    for way, number in product(ways, range(NUM_CLICKS + 1)):
        values, times = ([row[number] for row in table] for table in (way.overlaps, way.seconds))
        failures = ", ".join(name for name, value in zip(frames, values, strict=True) if value < BAD)
        good = str(sum(value >= GOOD for value in values))
        rows.append([str(way), str(number), f"{fmean(values):.2f}", good, failures, f"{fmean(times):.1f}"])
    titles = ["method", "clicks", "mean IoU", f"at least {GOOD}", f"below {BAD}", "seconds of a core"]
    print(markdown(titles, rows))


if __name__ == "__main__":
    main()
