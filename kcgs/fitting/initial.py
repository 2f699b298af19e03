"""The first Gaussians of a fit."""

from __future__ import annotations

import copy
import math
from typing import Any

import torch
from torch import Tensor

from kcgs._check import check_count
from kcgs.maps import RegionMap
from kcgs.nn import GaussianField

from .checks import check_images_and_regions, check_num_gaussians, is_batch
from .image_maps import map_of_each

# sum of all weights at a pixel, for Gaussians with a sigma of half their spacing
_OVERLAP = math.pi / 2


def initial_field(
    image: Any, num_gaussians: int, regions: RegionMap | Tensor | None = None, seed: int = 0
) -> GaussianField:
    r"""Scatter round Gaussians uniformly over an image, in its colours, as the start of a fit or of your own loop.

    Convention: standard deviations are half the spacing of the Gaussians, so that together they show a blurred image.
    No region starts without a Gaussian while another region has two. The same seed gives the same field. An image of a
    batch gets the same field as it gets alone.

    Args:
        image: as :func:`kcgs.fit` takes it, or a batch, :math:`(B, C, H, W)`.
        num_gaussians: N, from 1 to the number of pixels.
        regions: label map or RegionMap of the image's size; a batch has one for all images or one for each. Each
            Gaussian gets the region under its centre.
        seed: of the random centres.

    Returns:
        A field of N Gaussians, on the device of the image; a batch of B such fields for :math:`(B, C, H, W)`.

    Raises:
        TypeError, ValueError: as :func:`kcgs.fit`.

    Example:
        >>> from kcgs import RegionSplatRenderer
        >>> from kcgs.functional import psnr
        >>> image = torch.linspace(0.2, 0.8, 48).expand(3, 32, 48)
        >>> bool(psnr(RegionSplatRenderer()(initial_field(image, 60)), image) > 10)
        True
        >>> initial_field(torch.rand(4, 3, 32, 48), 60).means.shape
        torch.Size([4, 60, 2])
    """
    images, regions = check_images_and_regions(image, regions)
    count = check_num_gaussians(num_gaussians, images)
    field = uniform_field(images, count, regions, check_count("seed", seed, 0, 2**63 - 1))
    return field if is_batch(image) else field[0]


def uniform_field(images: Tensor, num_gaussians: int, regions: RegionMap | None, seed: int) -> GaussianField:
    """Scatter round Gaussians uniformly over images, (B, C, H, W), in their colours: see `initial_field`."""
    field = random_field(images, num_gaussians, regions, seed)
    x, y = field.means.detach().long().unbind(-1)
    pixels = (y * images.shape[3] + x)[:, None].expand(-1, images.shape[1], -1)
    field.colors.data = (images.flatten(2).gather(2, pixels).mT / _OVERLAP).contiguous()
    return field


def initial_sigma(size: tuple[int, int], num_gaussians: int) -> float:
    """Return half the spacing of the Gaussians on an image of this size, in pixels, at least 1."""
    return max(1.0, 0.5 * math.sqrt(size[0] * size[1] / num_gaussians))


def random_field(images: Tensor, num_gaussians: int, regions: RegionMap | None, seed: int) -> GaussianField:
    """Scatter round Gaussians uniformly over images, (B, C, H, W), in random colours, the same in all of them."""
    batch, channels, *size = images.shape
    sigma = initial_sigma((size[0], size[1]), num_gaussians)
    field = GaussianField.random(
        num_gaussians, (size[0], size[1]), channels=channels, sigma=sigma, seed=seed, dtype=images.dtype
    )
    if regions is None:
        tables = (table.detach().expand(batch, -1, -1) for table in (field.means, field.cholesky, field.colors))
        return GaussianField(*tables, size=field.size).to(images.device)
    maps = map_of_each(regions.to("cpu"), batch)  # on a GPU each empty region would cost a host sync
    fields = [_assign_regions(copy.deepcopy(field), one, seed) for one in maps]
    return GaussianField.stack(fields).to(images.device)


@torch.no_grad()
def _assign_regions(field: GaussianField, regions: RegionMap, seed: int) -> GaussianField:
    """Give Gaussians the regions under their centres, and move some Gaussians into empty regions."""
    field.assign_regions(regions)
    _fill_empty_regions(field, regions, seed)
    return field.assign_regions(regions)


def _fill_empty_regions(field: GaussianField, regions: RegionMap, seed: int) -> None:
    """Move a Gaussian from the fullest region to a random pixel of each empty region, the largest region first."""
    assert field.region_ids is not None
    generator = torch.Generator().manual_seed(seed)
    labels, index = regions.labels, regions.index_of(field.region_ids)
    counts = index.bincount(minlength=regions.num_regions)
    areas = regions.index_of(labels.flatten()).bincount(minlength=regions.num_regions)
    empty = [r for r in areas.argsort(descending=True, stable=True).tolist() if counts[r] == 0]
    for region in empty:
        donor = int(counts.argmax())
        if counts[donor] < 2:
            return
        row = int((index == donor).nonzero()[-1])
        pixels = (labels == regions.ids[region]).nonzero()
        y, x = pixels[int(torch.randint(len(pixels), (1,), generator=generator))].tolist()
        field.means[row] = field.means.new_tensor([x + 0.5, y + 0.5])
        index[row] = region
        counts[donor] -= 1
        counts[region] += 1
