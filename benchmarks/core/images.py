"""The images of experiments by name, with their label maps."""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from kcgs.data import Davis, chart_2x3, chart_pie, load_image
from kcgs.segment import segment

from .run import Options

CHARTS = ("2x3", "pie")
# first frames of DAVIS
FRAMES = ("blackswan", "breakdance", "car-turn", "dance-jump", "dog", "train")
PHOTOS = ("astronaut", "chelsea", "coffee", "rocket")
QUICK_STRIDE = 4
# columns and rows of photos of Kodak side by side, and where in the list they begin, by threes
STITCHED = re.compile(r"(\d+) x (\d+) photos(?: (\d+))?")


class Sample(NamedTuple):
    """An image and its label map."""

    image: Tensor  # (3, H, W)
    labels: Tensor | None  # (H, W); None: the image has no map


@lru_cache(maxsize=4)
def load(name: str, data: str | None = None, quick: bool = False) -> Sample:
    """Read a chart, "disc", a photo of scikit-image, BSDS (a number), Kodak (kodimN), or a sequence's first frame.

    "4 x 6 photos" are photos of Kodak in four columns and six rows. "2 x 2 photos 2" begin with the fourth photo,
    "2 x 2 photos 3" with the seventh.
    The quick form has one of four pixels a side.
    """
    stride = QUICK_STRIDE if quick else 1
    image, labels = _read(name, Path(data or ""))
    image = image[:, ::stride, ::stride].contiguous()
    return Sample(image, None if labels is None else labels[::stride, ::stride].contiguous())


def load_mapped(name: str, data: str | None = None, quick: bool = False) -> tuple[Tensor, Tensor]:
    """Read an image and its label map, or the map of `segment` where it has none."""
    image, labels = load(name, data, quick)
    return image, segment(image) if labels is None else labels


def resize(image: Tensor, size: tuple[int, int], resampling: str) -> Tensor:
    """Resize an image (C, H, W) by Pillow, in floats."""
    filter = Image.Resampling[resampling.upper()]
    planes = [np.asarray(Image.fromarray(plane.numpy()).resize(size[::-1], filter)) for plane in image]
    return torch.from_numpy(np.stack(planes)).clamp(0, 1)


def names(data: Path, group: str) -> list[str]:
    """List the images of "davis" (six frames), "kodak" or "bsds" that are in the data; a ValueError: there are none."""
    images = {
        "davis": [name for name in FRAMES if (data / "DAVIS" / "JPEGImages" / "480p" / name).is_dir()],
        "kodak": sorted(path.stem for path in (data / "kodak").glob("kodim*.png")),
        "bsds": sorted((path.parent.name for path in (data / "bsds").glob("*/image.jpg")), key=int),
    }[group]
    if not images:
        raise ValueError(f"data must have a folder with {group} in it; got {str(data)!r}")
    return images


def choose(options: Options, group: str) -> list[str]:
    """List the images of a group; without data, photos of scikit-image; in the quick form a disc."""
    return ["disc"] if options.quick else list(PHOTOS) if options.data is None else names(options.data, group)


def _read(name: str, data: Path) -> tuple[Tensor, Tensor | None]:
    if name in CHARTS:
        chart = chart_2x3() if name == "2x3" else chart_pie()
        return chart.image, chart.labels
    if name == "disc":
        return _disc()
    if name in PHOTOS:
        from skimage import data as photos

        return torch.from_numpy(getattr(photos, name)()).permute(2, 0, 1).float() / 255, None
    if name.isdigit():
        return load_image(data / "bsds" / name / "image.jpg"), None
    if name.startswith("kodim"):
        return load_image(data / "kodak" / f"{name}.png"), None
    if match := STITCHED.fullmatch(name):
        columns, rows, part = (int(number or 1) for number in match.groups())
        return _stitch(names(data, "kodak"), columns, rows, 3 * (part - 1), data), None
    frame = Davis(data / "DAVIS")[name]
    return frame.image, frame.labels


def _stitch(photos: list[str], columns: int, rows: int, first: int, data: Path) -> Tensor:
    """Put photos side by side, upright ones turned."""
    images = [_read(photos[(first + k) % len(photos)], data)[0] for k in range(rows * columns)]
    images = [image if image.shape[2] >= image.shape[1] else image.mT for image in images]
    return torch.cat([torch.cat(images[k : k + columns], 2) for k in range(0, len(images), columns)], 1)


def _disc() -> tuple[Tensor, Tensor]:
    """Make a disc with a pattern on a ramp, 320 x 400."""
    y, x = torch.meshgrid(torch.arange(320.0), torch.arange(400.0), indexing="ij")
    inside = (x - 180).square() + (y - 150).square() < 100**2
    pattern = 0.5 + 0.3 * torch.sin(x / 23 + y / 41)
    disc = torch.stack([pattern, 0.3 * pattern, 1 - pattern])
    ramp = torch.stack([x / 800, 0.3 + y / 800, 0.6 - x / 1600])
    return torch.where(inside, disc, ramp).contiguous(), inside.long()
