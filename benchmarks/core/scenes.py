"""Scenes of experiments: synthetic workloads, and fitted scenes of the zoo."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import torch
from torch import Tensor

from kcgs import GaussianField, RegionMap, Scene, load
from kcgs.functional import lookup_regions
from kcgs.zoo import find

# height, width, N; a pixel lies in 12 ellipses of 3 sigma on average
WORKLOADS = {"W3": (200, 300, 20), "W1": (480, 854, 1_250), "W2": (480, 854, 7_500), "W4": (2160, 3840, 50_000)}
_COVERAGE = 12.0
# 3.7, 6.3 and 11.4 Gaussians per thousand pixels; W1 has 3.0, W2 18
FITTED = ("rocket-1000", "coffee-1500", "astronaut-3000")
# fits of photos that do not come with kcgs, in DATA/scenes/NAME.safetensors: of the first frame of DAVIS dog with its
# mask, and of a photo of Kodak without regions
FITS = ("dog-1250", "dog-7500", "kodim05-10000")
# a workload of small images with a Gaussian for every 64 pixels: 64 of 128 x 128, or as many of a side as a suffix says
BATCH = "batch"
BATCHES = [f"{BATCH}-{images}-{side}" for images in (16, 64, 256) for side in (64, 128, 256)]
SIZES = ("native", "3840 wide")


def scene_of(name: str, data: str = "") -> Scene:
    """Make a workload, or read a scene of the zoo or of the data.

    "none", "hard" or "soft" behind the name are its contours; soft ones of a fit are its own.
    """
    name, _, contours = name.partition(" ")
    is_fitted = name not in (*WORKLOADS, BATCH, *BATCHES)
    scene = load(_path(data, name) if name in FITS else find(name)) if is_fitted else _synthetic(name)
    field, regions = scene.field, scene.regions
    if contours == "none" or regions is None:
        return Scene(GaussianField(field.means, field.cholesky, field.colors, size=field.size))
    if contours == "soft" and is_fitted:
        return scene
    return Scene(field, RegionMap(regions.labels, 0.7 if contours == "soft" else 0.0))


def fits_in(data: Path | None) -> list[str]:
    """List the FITS that are in the data; a line on standard error names the others."""
    folder = str(data or "")
    missing = [name for name in FITS if not _path(folder, name).is_file()]
    if missing:
        print(f"without {', '.join(missing)}: DATA/scenes/NAME.safetensors is missing", file=sys.stderr)
    return [name for name in FITS if name not in missing]


def _path(data: str, name: str) -> Path:
    return Path(data, "scenes", f"{name}.safetensors")


def _synthetic(name: str) -> Scene:
    if name in WORKLOADS:
        return workload(*WORKLOADS[name])
    images, side = (int(number) for number in name.split("-")[1:] or (64, 128))
    return batch(images, side, side, side**2 // 64)


def size_of(scene: Scene, size: str) -> tuple[int, int]:
    """Return height and width of one of SIZES."""
    height, width = scene.size
    return (height, width) if size == "native" else (round(3840 / width * height), 3840)


def workload(height: int, width: int, count: int, seed: int = 0) -> Scene:
    """Scatter Gaussians of about one size over five blocks and a disc."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    sigma = math.sqrt(height * width * _COVERAGE / (count * 9 * math.pi))
    means = uniform(count, 2) * torch.tensor([width, height])
    slant = 0.3 * torch.randn(count, generator=generator)
    cholesky = sigma * torch.stack([0.5 + uniform(count), slant, 0.5 + uniform(count)], -1)
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    blocks = (x * 3 // width + 3 * (y * 2 // height)) % 5
    disc = (x - width / 2) ** 2 + (y - height / 2) ** 2 < (height / 4) ** 2
    labels = torch.where(disc, 5, blocks)
    field = GaussianField(means, cholesky, uniform(count, 3), lookup_regions(means, labels), size=(height, width))
    return Scene(field, RegionMap(labels))


def batch(images: int, height: int, width: int, count: int) -> Scene:
    """Put workloads into a batch, each with its own map: the blocks and the disc of one, moved to the side."""
    scenes = [workload(height, width, count, seed) for seed in range(images)]
    field, regions = GaussianField.stack([scene.field for scene in scenes]), scenes[0].regions
    assert regions is not None
    labels = torch.stack([regions.labels.roll(index, 1) for index in range(images)])
    return Scene(field.assign_regions(labels), RegionMap(labels))
