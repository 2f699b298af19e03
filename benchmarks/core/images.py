"""The images that fits are made of, by name, with the label maps that they are given."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from kcgs.data import Davis, chart_2x3, chart_pie, load_image
from kcgs.segment import segment

CHARTS = ("2x3", "pie")
# stand in where there is no data
QUICK = ("astronaut", "disc")
FRAMES = (
    *("blackswan", "dog", "train", "breakdance", "car-turn", "dance-jump", "mallard-water", "rollerblade"),
    *("bmx-trees", "cows", "kite-surf", "paragliding-launch"),
)
PHOTOS = ("astronaut", "chelsea", "coffee", "rocket")


class Sample(NamedTuple):
    """An image and the label map whose contours the edge-focused figures look at."""

    image: Tensor  # (3, H, W)
    labels: Tensor | None  # (H, W); None: the image has none


def davis(data: Path | None) -> Davis:
    """Open DAVIS in the folder, or in its sub-folder DAVIS; a FileNotFoundError where the layout is another."""
    if data is None:
        raise ValueError("data must name a folder with DAVIS in it, --data DIR; got None")
    return Davis(data / "DAVIS" if (data / "DAVIS").is_dir() else data)


def sequences(data: Path | None, wanted: str | None, *, quick: bool) -> list[str]:
    """List the sequences named, with commas between them, or all; the quick form has two, or two images of its own."""
    names = None if wanted is None else list(dict.fromkeys(wanted.replace(" ", "").split(",")))
    if data is None and quick:
        if not set(names or ()) <= set(QUICK):
            raise ValueError(f"sequences must name some of {', '.join(QUICK)}; got {wanted!r}")
        return names or list(QUICK)
    frames = davis(data)
    if names is None:
        return frames.sequences[:2] if quick else frames.sequences
    for name in names:
        frames[name]
    return names


@lru_cache(maxsize=4)
def load(name: str, data: Path | None, stride: int = 1, factor: int = 1) -> Sample:
    """Read a chart, a photo of scikit-image, BSDS (a number) or Kodak (kodimN), a disc, or a sequence's first frame.

    One of `stride` pixels is taken a side; a `factor` reduces by area, whole blocks of the middle, labels by majority.
    """
    image, labels = _read(name, data)
    if stride > 1:
        image = image[:, ::stride, ::stride].contiguous()
        labels = None if labels is None else labels[::stride, ::stride].contiguous()
    if factor > 1:
        image, labels = whole_blocks(Sample(image, labels), factor)
        if labels is not None:
            labels = labels.unfold(0, factor, factor).unfold(1, factor, factor).flatten(2).mode(-1).values
        image = avg_pool2d(image, factor)
    return Sample(image, labels)


def whole_blocks(sample: Sample, factor: int) -> Sample:
    """Cut the middle whose sides are multiples of a factor."""
    starts = [(side % factor // 2, side // factor * factor) for side in sample.image.shape[1:]]
    rows, columns = (slice(start, start + length) for start, length in starts)
    labels = None if sample.labels is None else sample.labels[rows, columns].contiguous()
    return Sample(sample.image[:, rows, columns].contiguous(), labels)


def photo(name: str) -> Tensor:
    """Return a photo of scikit-image."""
    from skimage import data

    return torch.from_numpy(getattr(data, name)()).permute(2, 0, 1).float() / 255


def _read(name: str, data: Path | None) -> tuple[Tensor, Tensor | None]:
    if name in CHARTS:
        chart = chart_2x3() if name == "2x3" else chart_pie()
        return chart.image, chart.labels
    if name == "disc":
        return _disc()
    if name in PHOTOS:
        return photo(name), segment(photo(name))
    if data is not None and name.isdigit():
        return load_image(data / "bsds" / name / "image.jpg"), None
    if data is not None and name.startswith("kodim"):
        return load_image(data / "kodak" / f"{name}.png"), None
    frame = davis(data)[name]
    return frame.image, frame.labels


def _disc() -> tuple[Tensor, Tensor]:
    """Make a disc with a pattern on a ramp, 320 x 400."""
    y, x = torch.meshgrid(torch.arange(320.0), torch.arange(400.0), indexing="ij")
    inside = (x - 180).square() + (y - 150).square() < 100**2
    pattern = 0.5 + 0.3 * torch.sin(x / 23 + y / 41)
    disc = torch.stack([pattern, 0.3 * pattern, 1 - pattern])
    ramp = torch.stack([x / 800, 0.3 + y / 800, 0.6 - x / 1600])
    return torch.where(inside, disc, ramp).contiguous(), inside.long()
