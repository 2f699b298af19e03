"""Where the Gaussians start."""

from __future__ import annotations

import torch
from torch import Tensor

from kcgs.functional import RegionMap
from kcgs.nn import GaussianField


def random_field(
    image: Tensor, num_gaussians: int, sigma: float, regions: RegionMap | None, seed: int
) -> GaussianField:
    """Scatter round Gaussians uniformly over the image; no region starts empty while another has two.

    Args:
        image: (C, H, W); gives size, channels, dtype and device.
        num_gaussians: N.
        sigma: standard deviation in pixels.
        regions: the map whose ids they get; None: none.
        seed: of the draw.
    """
    size = (image.shape[1], image.shape[2])
    field = GaussianField.random(
        num_gaussians, size, channels=image.shape[0], sigma=sigma, seed=seed, dtype=image.dtype
    ).to(image.device)
    if regions is None:
        return field
    field.assign_regions(regions)
    with torch.no_grad():
        _fill_empty_regions(field, regions, seed)
    return field.assign_regions(regions)


def _fill_empty_regions(field: GaussianField, regions: RegionMap, seed: int) -> None:
    """Move Gaussians from the regions with most into those with none, the largest first, to a random pixel there."""
    assert field.region_ids is not None
    generator = torch.Generator().manual_seed(seed)
    index = regions.index_of(field.region_ids)
    counts = index.bincount(minlength=regions.num_regions)
    areas = regions.index_of(regions.labels.flatten()).bincount(minlength=regions.num_regions)
    empty = [r for r in areas.argsort(descending=True, stable=True).tolist() if counts[r] == 0]
    for region in empty:
        donor = int(counts.argmax())
        if counts[donor] < 2:
            return
        moved = int((index == donor).nonzero()[-1])
        pixels = (regions.labels == regions.ids[region]).nonzero()
        y, x = pixels[int(torch.randint(len(pixels), (1,), generator=generator))].tolist()
        field.means[moved] = field.means.new_tensor([x + 0.5, y + 0.5])
        index[moved] = region
        counts[donor] -= 1
        counts[region] += 1
