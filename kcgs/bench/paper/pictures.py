"""The pictures that fits are made of, by name, with the maps that they are given."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from kcgs.data import Davis, chart_2x3, chart_pie
from kcgs.functional import RegionMap

CHARTS = ("2x3", "pie")
# stand in where there is no data
QUICK = ("astronaut", "disc")
# a pixel of the pie is the mean of 8 x 8 samples: at this many labels a pixel its contours are exact
COVERAGE_LABELS = 8


class Picture(NamedTuple):
    """An image and its label map, whose contours the edge-focused figures look at."""

    image: Tensor  # [3, H, W]
    labels: Tensor  # [H, W]


def davis(data: Path | None) -> Davis:
    """Open DAVIS in the folder, or in its sub-folder DAVIS.

    Raises:
        ValueError: no folder.
        FileNotFoundError: it has not the official layout.
    """
    if data is None:
        raise ValueError("data must name a folder with DAVIS in it, --data DIR; got None")
    return Davis(data / "DAVIS" if (data / "DAVIS").is_dir() else data)


def sequences(data: Path | None, wanted: str | None, *, quick: bool) -> list[str]:
    """List what is to be fitted: the sequences named, with commas between them, or all in alphabetical order.

    Args:
        data: as in `davis`; None is enough for the quick form, which has two pictures of its own then.
        wanted: names; None: all, of the quick form two.
        quick: whether it is the quick form.

    Raises:
        ValueError: no data, or no sequence of that name.
    """
    if data is None and quick:
        present = list(QUICK)
        chosen = present if wanted is None else [name.strip() for name in wanted.split(",")]
        if not set(chosen) <= set(present):
            raise ValueError(f"sequences must name some of {', '.join(present)}; got {wanted!r}")
        return chosen
    found = davis(data)
    if wanted is not None:
        # in the order in which they are named
        names = [name.strip() for name in wanted.split(",")]
        for name in names:
            found[name]
        return list(dict.fromkeys(names))
    return found.sequences[:2] if quick else found.sequences


@lru_cache(maxsize=4)
def load(name: str, data: Path | None, stride: int = 1) -> Picture:
    """Read a picture: a chart, a stand-in, or the first frame of a sequence; of `stride` pixels one is taken."""
    image, labels = _read(name, data)
    if stride > 1:
        image = image[:, ::stride, ::stride].contiguous()
        labels = labels[::stride, ::stride].contiguous()
    return Picture(image, labels)


def coverage_map() -> RegionMap:
    """Return the pie's contours as its own edges were sampled."""
    return RegionMap.from_labels(chart_pie(COVERAGE_LABELS).labels, supersample=COVERAGE_LABELS)


def _read(name: str, data: Path | None) -> tuple[Tensor, Tensor]:
    if name in CHARTS:
        chart = chart_2x3() if name == "2x3" else chart_pie()
        return chart.image, chart.labels
    if name == "disc":
        return _disc()
    if name == "astronaut":
        from skimage import data as photos

        from kcgs.segment import segment

        image = torch.from_numpy(photos.astronaut()).permute(2, 0, 1).float() / 255
        return image, segment(image)
    frame = davis(data)[name]
    return frame.image, frame.labels


def _disc() -> tuple[Tensor, Tensor]:
    """Draw a striped disc on a ramp, 320 x 400."""
    y, x = torch.meshgrid(torch.arange(320.0), torch.arange(400.0), indexing="ij")
    inside = (x - 180).square() + (y - 150).square() < 100**2
    stripes = 0.5 + 0.3 * torch.sin(x / 23 + y / 41)
    disc = torch.stack([stripes, 0.3 * stripes, 1 - stripes])
    ramp = torch.stack([x / 800, 0.3 + y / 800, 0.6 - x / 1600])
    return torch.where(inside, disc, ramp).contiguous(), inside.long()
