"""The pictures, and which of them a group takes."""

from __future__ import annotations

import time
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from kcgs.data import Davis, load_image, load_labels

MATCHED, DAVIS_CURVE, KODAK_CURVE = "davis8k", "davis-curve", "kodak-curve"
PRECISION, MAPS, SPEED = "precision", "maps", "speed"
# the folders of the data that a group reads
GROUPS = {
    MATCHED: ("DAVIS",),
    PRECISION: ("DAVIS",),
    MAPS: ("DAVIS", "bsds"),
    DAVIS_CURVE: ("DAVIS",),
    KODAK_CURVE: ("kodak",),
    SPEED: ("DAVIS",),
}
FRAMES = (
    *("blackswan", "dog", "train", "breakdance", "car-turn", "dance-jump", "mallard-water", "rollerblade"),
    *("bmx-trees", "cows", "kite-surf", "paragliding-launch"),
)
_NAMES = {
    MATCHED: FRAMES,
    PRECISION: FRAMES[:4],
    DAVIS_CURVE: FRAMES[:3],
    KODAK_CURVE: ("kodim23", "kodim07", "kodim19"),
    SPEED: FRAMES[:1],
}
MOST_BYTES, QUICK_BYTES = 7_950, 700
TARGETS, QUICK_TARGETS = (2_000, 4_000, 8_000, 16_000, 32_000), (450, 900)
COUNTS, QUICK_COUNTS = (1_250, 7_500), (40,)
SYNTHETIC = "synthetic"


class Picture(NamedTuple):
    """A picture and its label map; the contours of that are what edge-focused figures look at."""

    image: Tensor
    labels: Tensor
    seconds: float = 0.0  # that finding the labels took; 0: they were given


def missing(group: str, data: Path | None) -> str | None:
    """Say why a group cannot be run, None if it can."""
    if data is None:
        return "it needs a data folder"
    for folder in GROUPS[group]:
        if not (data / folder).is_dir():
            return f"the data folder has no {folder}"
    return None if names(group, data, False) else "the data folder has none of its pictures"


def names(group: str, data: Path | None, quick: bool) -> list[str]:
    """List a group's pictures."""
    if quick:
        return [] if group == KODAK_CURVE else [SYNTHETIC]  # one curve will do
    assert data is not None
    if group == MAPS:
        return [f"DAVIS/{name}" for name in Davis(data / "DAVIS").sequences] + _bsds_maps(data)
    if group == KODAK_CURVE:
        return [name for name in _NAMES[group] if (data / "kodak" / f"{name}.png").is_file()]
    there = Davis(data / "DAVIS").sequences
    return [name for name in _NAMES[group] if name in there]


def _bsds_maps(data: Path) -> list[str]:
    found = sorted((data / "bsds").glob("*/mask*.png"), key=lambda path: (len(path.parent.name), path))
    return [f"bsds/{path.parent.name}/{path.stem}" for path in found]


def read_map(name: str, data: Path | None) -> Tensor:
    """Read a label map by the name that it has in the group of maps."""
    if name == SYNTHETIC:
        return _synthetic().labels
    assert data is not None
    folder, rest = name.split("/", 1)
    return Davis(data / folder)[rest].labels if folder == "DAVIS" else load_labels(data / f"{name}.png")


@lru_cache(maxsize=2)
def read(group: str, name: str, data: Path | None) -> Picture:
    """Read a picture; one without annotation gets the map that kcgs finds in it."""
    if name == SYNTHETIC:
        return _synthetic()
    assert data is not None
    if group != KODAK_CURVE:
        frame = Davis(data / "DAVIS")[name]
        return Picture(frame.image, frame.labels)
    from kcgs.segment import segment

    image = load_image(data / "kodak" / f"{name}.png")
    segment(image[:, :64, :64])  # what it imports is no part of its time
    start = time.perf_counter()
    labels = segment(image)
    return Picture(image, labels, time.perf_counter() - start)


def _synthetic() -> Picture:
    """Make a shaded disk before stripes: a contour, something smooth and something fine."""
    y, x = torch.meshgrid(torch.arange(164) + 0.5, torch.arange(164) + 0.5, indexing="ij")
    disk = (x - 80).square() + (y - 85).square() < 50**2
    ground = torch.stack([0.4 + 0.3 * torch.sin(0.15 * x + 0.05 * y), 0.3 + y / 400, 0.5 + 0.2 * torch.cos(0.1 * y)])
    shaded = torch.stack([0.9 - x / 600, 0.5 + 0.2 * torch.sin(0.1 * y), 0.1 + y / 500])
    return Picture(torch.where(disk, shaded, ground), disk.long())
