"""Images, label maps and Gaussians of the golden cases, made without the library."""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

from .adapter import Parts, Softness

SIZE = (40, 56)
IDS = (2, 7, 11, 400)
PAIRS: Softness = {(2, 7): 0.8, (7, 11): 0.0, (2, 400): 1.3}


def _grid(size: tuple[int, int], factor: int = 1) -> tuple[Tensor, Tensor]:
    height, width = size
    y, x = ((torch.arange(n * factor, dtype=torch.float64) + 0.5) / factor for n in (height, width))
    return y[:, None].expand(-1, len(x)), x[None].expand(len(y), -1)


@functools.cache
def map_of(size: tuple[int, int] = SIZE, factor: int = 1, ids: tuple[int, ...] = IDS) -> Tensor:
    """A disc, a slanted contour and a thin bar: four regions."""
    y, x = _grid(size, factor)
    height, width = size
    index = (x + 0.4 * y > 0.55 * width).long()
    index[(x - 0.3 * width) ** 2 + (y - 0.5 * height) ** 2 < (0.26 * height) ** 2] = 2
    index[(y > 0.78 * height) & (y < 0.78 * height + 4)] = 3
    return torch.tensor(ids)[index]


@functools.cache
def textured(size: tuple[int, int] = SIZE, channels: int = 3) -> Tensor:
    """Regions of different colours with ramps, waves and noise, anti-aliased."""
    fine = map_of(size, 4)
    y, x = _grid(size, 4)
    color = torch.rand(len(IDS), channels, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    index = torch.searchsorted(torch.tensor(IDS), fine)
    image = 0.2 + 0.6 * color[index].permute(2, 0, 1) + 0.15 * torch.sin(0.9 * x + 0.3 * y * (index + 1)) * (index % 2)
    image = torch.nn.functional.avg_pool2d(image[None], 4)[0]
    noise = torch.rand(image.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return (image + 0.05 * (noise - 0.5)).clamp(0, 1).float()


@functools.cache
def flat_chart() -> tuple[Tensor, Tensor]:
    """A flat image of three colours, anti-aliased, and its map."""
    size, ids = (24, 36), (0, 1, 2, 1)
    colors = torch.tensor([[1.0, 0.9, 0.2], [0.1, 0.4, 0.8], [0.9, 0.1, 0.1]], dtype=torch.float64)
    image = torch.nn.functional.avg_pool2d(colors[map_of(size, 8, ids)].permute(2, 0, 1)[None], 8)[0]
    return image.float(), map_of(size, ids=ids)


@functools.cache
def photo() -> Tensor:
    """A crop of the astronaut, (3, 64, 80)."""
    from skimage import data

    crop = torch.from_numpy(data.astronaut())[0:256, 100:420].permute(2, 0, 1).double() / 255
    return crop.reshape(3, 64, 4, 80, 4).mean((2, 4)).float()


@functools.cache
def blurred() -> tuple[Tensor, Tensor]:
    """A smooth image with one sharp disc, and a map of the disc and of columns that the image does not show."""
    y, x = _grid(SIZE)
    disc = (x - 28) ** 2 + (y - 20) ** 2 < 81
    ramp = torch.stack([x / 56, y / 40, 0.5 + 0.3 * torch.sin(x / 9 + y / 7)])
    return torch.where(disc, 1.0 - ramp, ramp).float(), torch.where(disc, 9, (x / 14).long())


@functools.cache
def photo_map() -> Tensor:
    """Regions of the photo by brightness, specks and all."""
    smooth = torch.nn.functional.avg_pool2d(photo()[None].double().mean(1), 5, stride=1, padding=2)[0]
    return (smooth * 4).long()


def only_map(softness: Softness = 0.0, labels: Tensor | None = None) -> Parts:
    """A map alone, for a fit."""
    empty = torch.zeros(0, 0)
    labels = map_of() if labels is None else labels
    return Parts(empty, empty, empty, labels=labels, softness=softness)


def gaussians(
    count: int = 90,
    size: tuple[int, int] = SIZE,
    *,
    softness: Softness = 0.0,
    regions: bool = True,
    ids: tuple[int, ...] = IDS,
    channels: int = 3,
    seed: int = 0,
    batch: int | None = None,
    dtype: torch.dtype = torch.float32,
    opacities: bool = False,
) -> Parts:
    """Gaussians of all sizes and angles, some beyond the border, over the map."""
    generator = torch.Generator().manual_seed(seed)
    lead = (count,) if batch is None else (batch, count)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*lead, *shape, generator=generator, dtype=torch.float64)

    height, width = size
    means = (1.3 * uniform(2) - 0.15) * torch.tensor([width, height])
    a, b = (0.4 * 30.0 ** uniform(2)).unbind(-1)
    angle = math.pi * uniform()
    xx = (a * angle.cos()) ** 2 + (b * angle.sin()) ** 2
    l11 = xx.sqrt()
    cholesky = torch.stack([l11, (a**2 - b**2) * angle.cos() * angle.sin() / l11, a * b / l11], -1)
    colors = 0.8 * uniform(channels) - 0.15
    labels = map_of(size, ids=ids) if regions else None
    region_ids = None
    if labels is not None:
        column, row = means.floor().long().unbind(-1)
        region_ids = labels[row.clamp(0, labels.shape[0] - 1), column.clamp(0, labels.shape[1] - 1)]
    alpha = uniform().to(dtype) if opacities else None
    tensors = (t.to(dtype) for t in (means, cholesky, colors))
    return Parts(*tensors, region_ids, labels, size, softness, alpha)
