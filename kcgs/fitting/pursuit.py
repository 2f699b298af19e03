"""Where new Gaussians should go: matching pursuit on the error, many Gaussians in a round."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from kcgs._check import check_count, check_floating
from kcgs.functional import RegionMap, halve, lookup_regions, region_splat
from kcgs.kernels import check_backend, takes_triton
from kcgs.nn import GaussianField, pad_rows
from kcgs.optim import Objective, Renderer

from .checks import map_of_each, regions_of
from .state import FitState

# Standard deviations that are tried, in pixels, by the side of the blocks that the residual is averaged over for them.
# More of them, and smaller blocks, cost time, and descent changes them anyway.
_SIGMAS = {1: (0.7, 1.1), 2: (1.8, 2.9), 4: (4.7,), 8: (7.5,)}
# reach of a filter, in standard deviations
_REACH = 3.0
# distance within which no other place gains more, in standard deviations
_RADIUS = 1.5
# by which equal gains are made to differ
_SCATTER = 1e-4
_CUTOFF = 1e-4


class _Scale(NamedTuple):
    """Gains and colours of Gaussians of one size, each alone, at the middle of each block of an image."""

    sigma: float  # pixels
    block: int  # side of the blocks, pixels
    gain: Tensor  # [h, w], fall of the squared error
    colors: Tensor  # [C, h, w], of least squares


def propose_gaussians(
    error: Tensor, num_gaussians: int, regions: RegionMap | Tensor | None = None, *, backend: str = "auto"
) -> GaussianField:
    r"""Find the Gaussians to add to a render, for :meth:`kcgs.optim.GaussianAdam.append`.

    Convention: they are round, and lower the squared error most. Alone, a Gaussian g lowers it by
    :math:`\sum_c \langle g, e_c \rangle^2 / \langle g, g \rangle`, with products over pixels of its region. A round
    adds the strongest local maxima of this gain over places and sizes; the next one begins with the error that is left.
    Nothing is sampled at random. The strongest of each round come first.

    Args:
        error: image - render, :math:`(C, H, W)`, or of a batch, :math:`(B, C, H, W)`, floating.
        num_gaussians: how many to find for each image, at least 1; there are fewer where no others lower the error.
        regions: the RegionMap or label map of the render, of the error's size, for a batch one for all or one for each
            image; each Gaussian gets the region under its centre. None: Gaussians are not confined.
        backend: as in :func:`kcgs.functional.region_splat`.

    Returns:
        A field, without a graph; a batch of them for :math:`(B, C, H, W)`, where rows of an image that finds fewer
        than others have the colour 0.

    Raises:
        TypeError: an error that is no floating Tensor, or a number that is not whole.
        ValueError: an error of another shape or that is not finite, a number below 1, maps of another size or number.

    Example:
        >>> from kcgs.functional import region_splat
        >>> means, cholesky, colors = torch.tensor([[9.0, 7.0]]), torch.tensor([[1.8, 0.0, 1.8]]), torch.ones(1, 3)
        >>> error = region_splat(means, cholesky, colors, size=(16, 24))
        >>> propose_gaussians(error, 1).means.detach()
        tensor([[9., 7.]])

    Source: Mallat and Zhang, "Matching Pursuits with Time-Frequency Dictionaries", 1993, many atoms in a round.
    """
    error = check_floating("error", error, dims=(3, 4)).detach()
    error = error.to(torch.promote_types(error.dtype, torch.float32)).contiguous()
    batch = len(error) if error.ndim == 4 else None
    map_of_error = regions_of(tuple(error.shape[-2:]), regions, batch)
    count, backend = check_count("num_gaussians", num_gaussians), check_backend(backend)
    if batch is None:
        return propose(error, map_of_error, count, backend=backend)
    maps = map_of_each(map_of_error, batch)
    fields = [propose(one, of_one, count, backend=backend) for one, of_one in zip(error, maps, strict=True)]
    most = max(field.num_gaussians for field in fields)
    return GaussianField.stack([pad_rows(field, most, of_one) for field, of_one in zip(fields, maps, strict=True)])


def propose(residual: Tensor, regions: RegionMap | None, count: int, *, backend: str = "auto") -> GaussianField:
    """Do what `propose_gaussians` does, with arguments that are checked; `count` may be 0."""
    residual = residual.detach()
    # below this the gain is rounding error: one pixel's, at the precision of the largest
    floor = (128 * torch.finfo(residual.dtype).eps * float(residual.abs().max())) ** 2
    size = residual.shape[1], residual.shape[2]
    parts = [[residual.new_zeros(0, columns) for columns in (2, 3, len(residual))]]
    region_ids = [] if regions is None else [regions.ids[:0]]
    missing = count
    with torch.no_grad():
        while missing > 0:
            gain, means, sigma, colors = _local_maxima(residual, regions, floor)
            if not len(gain):
                break
            strongest = gain.sort(descending=True, stable=True)[1][:missing]
            means, sigma, colors = means[strongest], sigma[strongest], colors[strongest]
            cholesky = torch.stack([sigma, torch.zeros_like(sigma), sigma], -1)
            ids = None if regions is None else lookup_regions(means, regions.labels)
            rendered = region_splat(means, cholesky, colors, ids, regions, size=size, cutoff=_CUTOFF, backend=backend)
            # Gaussians overlap: a step of the best length makes the fall of the error certain
            length = rendered.flatten().dot(residual.flatten()) / rendered.flatten().dot(rendered.flatten())
            if not bool(length > 0):
                break
            parts.append([means, cholesky, colors * length])
            region_ids += [] if ids is None else [ids]
            residual, missing = torch.addcmul(residual, rendered, length, value=-1.0), missing - len(means)
    means, cholesky, colors = (torch.cat(rows) for rows in zip(*parts, strict=True))
    return GaussianField(means, cholesky, colors, torch.cat(region_ids) if region_ids else None, size=size)


def propose_for(objective: Objective, rendered: Tensor, renderer: Renderer, count: int) -> GaussianField:
    """Find at most `count` Gaussians that lower an objective of a render, (C, H, W), most: see `propose`."""
    error, root = objective.residual(rendered)
    added = propose(error, renderer.regions, count, backend=renderer.backend)
    if isinstance(root, Tensor):
        x, y = added.means.detach().long().unbind(-1)
        added.colors.data = added.colors.detach() / root[y, x, None]
    return added


def add_gaussians(state: FitState, count: int) -> None:
    """Add at most so many Gaussians to a fit, if any, that lower its objective most."""
    if count > 0:
        added = propose_for(state.objective, state.render().detach(), state.renderer, count)
        state.optimizer.append(state.field, added)


def _local_maxima(residual: Tensor, regions: RegionMap | None, floor: float) -> tuple[Tensor, ...]:
    """Return gain, mean, sigma and colours of each Gaussian that gains more than all others of any size nearby."""
    labels = None if regions is None else regions.index[0].to(residual.dtype)
    best, factors, block = torch.zeros_like(residual[0]), _scatter(residual[0]), 1
    scales, parts = [], []
    for scale in _scales(residual, labels):
        middles = _middles(best, scale.block)
        scale.gain.mul_(_middles(factors, scale.block))
        torch.maximum(middles, scale.gain, out=middles)
        scales.append(scale)
        # in a region of one pixel all sizes are the same: the first counts
        factors.mul_(1.0 - _SCATTER)
    for sigma, side, gain, colors in scales:
        while block < side:
            best, block = _halve_by_maximum(best), 2 * block
        highest = _pool(best, round(_RADIUS * sigma / block))[: len(gain), : gain.shape[1]]
        rows, columns = torch.nonzero((gain >= highest) & (gain > floor), as_tuple=True)
        means = (torch.stack([columns, rows], -1) + 0.5).to(gain.dtype) * block
        parts.append((gain[rows, columns], means, means.new_full((len(means),), sigma), colors[:, rows, columns].T))
    return tuple(torch.cat(columns) for columns in zip(*parts, strict=True))


def _scales(residual: Tensor, labels: Tensor | None) -> Iterator[_Scale]:
    """Evaluate each size of Gaussians, as long as the image has a block of it."""
    pixels = torch.cat([residual, torch.ones_like(residual[:1])])
    for block, sigmas in _SIGMAS.items():
        if min(residual.shape[1:]) < block:
            return
        planes = _average(pixels, labels, block)
        middle_labels = None if labels is None else _middles(labels, block).contiguous()
        for sigma in sigmas:
            gain, colors = _evaluate(planes, middle_labels, sigma / block)
            yield _Scale(sigma, block, gain.mul_(block**2), colors)


def _scatter(plane: Tensor) -> Tensor:
    """Return factors of almost 1 that differ from place to place, so that maxima of a flat error lie apart."""
    # the fractions of their sums are a sequence of low discrepancy: any few of the largest are spread over the plane
    row, column = (
        (step * torch.arange(length, device=plane.device, dtype=torch.float64)).frac().to(plane.dtype)
        for step, length in zip((0.7548776662466927, 0.5698402909980532), plane.shape, strict=True)
    )
    return (row[:, None] + column).frac_().mul_(-_SCATTER).add_(1.0)


def _middles(plane: Tensor, block: int) -> Tensor:
    """Return the view of the pixel in the middle of each whole block, of four the last."""
    height, width = (length // block * block for length in plane.shape)
    return plane[block // 2 : height : block, block // 2 : width : block]


def _average(planes: Tensor, labels: Tensor | None, block: int) -> Tensor:
    """Return the means of whole blocks, whose side is a power of 2.

    Of a block that a contour crosses, pixels that differ in label from its middle count as 0.
    """
    if labels is not None and block > 1:
        if planes.is_cpu:
            from .pursuit_loops import average  # loads numba

            return average(planes, labels, block)
        middles = _middles(labels, block)
        height, width = (length * block for length in middles.shape)
        blocks = labels[:height, :width].unflatten(1, (-1, block)).unflatten(0, (-1, block))
        planes = planes[:, :height, :width] * (blocks == middles[:, None, :, None]).view(height, width)
    while block > 1:
        planes, block = halve(planes), block // 2
    return planes


def _evaluate(planes: Tensor, labels: Tensor | None, sigma: float) -> tuple[Tensor, Tensor]:
    """Return gain and colours of Gaussians at the pixels of planes, the last of which has the pixels' weights.

    Filters run along columns, then along rows, each time over the pixels of the same label alone. So a Gaussian sees
    those of its region that it reaches by a column and a row.
    """
    # the square of a Gaussian is one, too, narrower by sqrt 2
    arguments = planes, labels, sigma, sigma / math.sqrt(2.0), math.ceil(_REACH * sigma)
    if not takes_triton(planes):
        from .pursuit_loops import evaluate  # loads numba

        return evaluate(*arguments)
    from .cuda import blur  # loads triton

    blurred = blur(*arguments)
    colors = blurred[:-1] / blurred[-1]
    return (blurred[:-1] * colors).sum(0), colors


def _pool(plane: Tensor, radius: int) -> Tensor:
    """Return the largest value of each square of side 2 radius + 1."""
    if not plane.is_cpu:
        return max_pool2d(plane[None], 2 * radius + 1, 1, radius)[0]
    # torch's pooling takes six times as long
    plane = pad(plane, [radius] * 4)
    for dim in (0, 1):
        length = plane.shape[dim] - 2 * radius
        plane = functools.reduce(torch.maximum, (plane.narrow(dim, start, length) for start in range(2 * radius + 1)))
    return plane


def _halve_by_maximum(plane: Tensor) -> Tensor:
    """Return the largest value, none negative, of each block of 2 x 2, of which the last may have less."""
    plane = pad(plane, [0, plane.shape[1] % 2, 0, plane.shape[0] % 2])
    rows = torch.maximum(plane[::2], plane[1::2])
    return torch.maximum(rows[:, ::2], rows[:, 1::2])
