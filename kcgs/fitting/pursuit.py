"""Matching pursuit: find the Gaussians to add to a render, many in each round."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from kcgs._check import check_count, check_floating
from kcgs.functional import halve, region_splat
from kcgs.kernels import check_backend, takes_triton
from kcgs.maps import RegionMap, lookup_regions, pixels_under
from kcgs.nn import GaussianField, used_rows
from kcgs.optim import Objective, Renderer

from .checks import regions_of
from .state import FitState

# Standard deviations of candidates, in pixels, by the side of the blocks over which the residual is averaged for them.
# More sizes and smaller blocks cost time; descent changes the sizes anyway.
_SIGMAS = {1: (0.7, 1.1), 2: (1.8, 2.9), 4: (4.7,), 8: (7.5,)}
# reach of a filter, in standard deviations
_REACH = 3.0
# a local maximum has the largest gain within this distance, in standard deviations
_RADIUS = 1.5
# largest relative change of a gain that breaks ties
_SCATTER = 1e-4
# weights below it are skipped in the render of candidates
_CUTOFF = 1e-4


class _Scale(NamedTuple):
    """Gain and colour of a single Gaussian of one size, at the middle of each block of images."""

    sigma: float  # pixels
    block: int  # side of the blocks, pixels
    gain: Tensor  # [B, h, w], decrease of the squared error
    colors: Tensor  # [B, C, h, w], least-squares solution


def propose_gaussians(
    error: Tensor, num_gaussians: int, regions: RegionMap | Tensor | None = None, *, backend: str = "auto"
) -> GaussianField:
    r"""Find the Gaussians to add to a render, for :meth:`kcgs.optim.GaussianAdam.append`.

    Convention: the Gaussians are round, and lower the squared error most. A single Gaussian g lowers it by
    :math:`\sum_c \langle g, e_c \rangle^2 / \langle g, g \rangle`, with products over the pixels of its region. A round
    adds the strongest local maxima of this gain over positions and sizes; the next round starts from the remaining
    error. Nothing is sampled at random. Rows are in the order of rounds, and in each round the strongest come first.

    Args:
        error: image - render, :math:`(C, H, W)`, or a batch, :math:`(B, C, H, W)`, floating.
        num_gaussians: how many Gaussians to find for each image, at least 1; the result has fewer if no others lower
            the error.
        regions: the RegionMap or label map of the render, of the error's size; a batch has one for all images or one
            for each. Each Gaussian gets the region under its centre. None: Gaussians are not confined.
        backend: as in :func:`kcgs.functional.region_splat`.

    Returns:
        A field, without a graph; a batch of fields for :math:`(B, C, H, W)`, padded with unused rows for
        images with fewer Gaussians.

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
    return propose(error, map_of_error, count, backend=backend)


class _Proposals(NamedTuple):
    """The Gaussians of all images of a batch in one list."""

    image: Tensor  # [M], index of the image of each
    means: Tensor  # [M, 2]
    cholesky: Tensor  # [M, 3]
    colors: Tensor  # [M, C]

    def select(self, rows: Tensor) -> _Proposals:
        """Return the Gaussians of an index or a mask."""
        return _Proposals(*(column[rows] for column in self))

    def by_image(self, batch: int) -> tuple[_Proposals, Tensor]:
        """Return the Gaussians in the order of images, and the rank of each within its image."""
        proposals = self.select(self.image.sort(stable=True)[1])
        counts = proposals.image.bincount(minlength=batch)
        firsts = counts.cumsum(0) - counts
        return proposals, torch.arange(len(proposals.image), device=counts.device) - firsts[proposals.image]

    def rows(self, batch: int) -> list[Tensor]:
        """Return means, factors and colours, (B, K, ...), of each image, padded with unused rows."""
        proposals, place = self.by_image(batch)
        most = int(place.max()) + 1 if len(place) else 0
        tables = [
            column.new_full((batch, most, column.shape[1]), fill)
            for column, fill in zip(proposals[1:], (1.0, 1.0, 0.0), strict=True)
        ]
        for table, column in zip(tables, proposals[1:], strict=True):
            table[proposals.image, place] = column
        return tables


@torch.no_grad()
def propose(
    residual: Tensor, regions: RegionMap | None, count: int | Tensor, *, backend: str = "auto"
) -> GaussianField:
    """Do what `propose_gaussians` does, with checked arguments; `count` may be 0, or (B,) with one for each image."""
    residual = residual.detach()
    is_batch, size = residual.ndim == 4, (residual.shape[-2], residual.shape[-1])
    residual = residual if is_batch else residual[None]
    # gains below this are rounding errors of one pixel of the largest error
    largest = residual.abs().amax((1, 2, 3)).double()
    floor = (128 * torch.finfo(residual.dtype).eps * largest).square()
    missing = torch.zeros_like(floor, dtype=torch.int64) + count
    batch = len(residual)
    rounds = [_Proposals(missing[:0], *(residual.new_zeros(0, columns) for columns in (2, 3, residual.shape[1])))]
    while bool((missing > 0).any()):
        candidates = _strongest(residual, regions, floor, missing)
        if not len(candidates.image):
            break
        means, cholesky, colors = candidates.rows(batch)
        ids = None if regions is None else lookup_regions(means, regions.labels)
        rendered = region_splat(means, cholesky, colors, ids, regions, size=size, cutoff=_CUTOFF, backend=backend)
        # Gaussians overlap: a step of the best length is sure to lower the error
        length = _products(rendered, residual) / _products(rendered, rendered)
        is_useful = length > 0
        length = torch.where(is_useful, length, 0.0)
        candidates = candidates.select(is_useful[candidates.image])
        rounds.append(candidates._replace(colors=candidates.colors * length[candidates.image, None]))
        residual = torch.addcmul(residual, rendered, length.view(-1, 1, 1, 1), value=-1.0)
        missing = torch.where(is_useful, missing - candidates.image.bincount(minlength=batch), 0)
    proposals = _Proposals(*(torch.cat(columns) for columns in zip(*rounds, strict=True)))
    means, cholesky, colors = proposals.rows(batch)
    ids = None if regions is None else lookup_regions(means, regions.labels)
    field = GaussianField(means, cholesky, colors, ids, size=size)
    return field if is_batch else field[0]


def _products(first: Tensor, second: Tensor) -> Tensor:
    """Return the inner product of two batches for each image, (B,)."""
    pairs = zip(first.flatten(1), second.flatten(1), strict=True)
    # on a CPU an image of a batch gets the same bits as a single image
    return torch.stack([a.dot(b) for a, b in pairs]) if first.is_cpu else (first * second).sum((1, 2, 3))


def propose_for(objective: Objective, rendered: Tensor, renderer: Renderer, count: int | Tensor) -> GaussianField:
    """Find the Gaussians, at most `count`, that lower the objective of each render, (..., C, H, W), most."""
    error, root = objective.residual(rendered)
    added = propose(error, renderer.regions, count, backend=renderer.backend)
    if isinstance(root, Tensor):
        y, x = pixels_under(added.means.detach(), renderer.size)
        pixels = y * renderer.size[1] + x
        added.colors.data = added.colors.detach() / root.flatten(-2).gather(-1, pixels)[..., None]
    return added


def add_gaussians(state: FitState, count: int, fewer: Sequence[int] = ()) -> None:
    """Add the Gaussians, at most `count`, that lower the objective of each image of a fit most.

    In a batch, new Gaussians also replace an image's frozen rows. Where an image can use fewer Gaussians than others,
    the rest of its rows are unused and frozen.

    Args:
        state: of the fit.
        count: largest number of new rows.
        fewer: for each image, how many Gaussians it gets fewer than `count`; () if all images get the same number.
    """
    if count <= 0:
        return
    field, optimizer = state.field, state.optimizer
    if state.problem.num_images == 1:
        optimizer.append(field, propose_for(state.objective, state.render().detach(), state.renderer, count))
        return
    is_used = ~optimizer.frozen_rows(field)
    missing = count + (~is_used).sum(1) - torch.tensor(fewer or [0], device=is_used.device)
    missing.index_fill_(0, torch.tensor(state.diverged, dtype=torch.int64, device=is_used.device), 0)
    added = propose_for(state.objective, state.render().detach(), state.renderer, missing)
    optimizer.append(field, added)
    is_used = torch.cat([is_used, used_rows(added.colors)], 1)
    num_used = is_used.sum(1, keepdim=True)
    # keep the same number of rows of each image: those in use, and the first frozen rows
    is_kept = is_used | ((~is_used).cumsum(1) <= num_used.max() - num_used)
    if not bool(is_kept.all()):
        optimizer.keep(field, is_kept)
    is_frozen = ~is_used[is_kept].view(len(is_used), -1)
    if bool(is_frozen.any()):
        optimizer.freeze(field, is_frozen)


def _strongest(residual: Tensor, regions: RegionMap | None, floor: Tensor, missing: Tensor) -> _Proposals:
    """Return the strongest local maxima of each image, at most `missing`, (B,), the strongest first."""
    active = missing.nonzero()[:, 0]  # images
    index = None if regions is None else regions.index
    if index is not None and len(index) > 1:
        index = index[active]
    image, gain, means, sigma, colors = _local_maxima(residual[active], index, floor[active])
    cholesky = torch.stack([sigma, torch.zeros_like(sigma), sigma], -1)
    proposals = _Proposals(active[image], means, cholesky, colors).select(gain.sort(descending=True, stable=True)[1])
    proposals, place = proposals.by_image(len(missing))
    return proposals.select(place < missing[proposals.image])


def _local_maxima(residual: Tensor, index: Tensor | None, floor: Tensor) -> tuple[Tensor, ...]:
    """Return image, gain, mean, sigma and colours of each Gaussian with the largest gain nearby, over all sizes.

    Args:
        residual: (B, C, H, W).
        index: region index of each pixel, (B, H, W), or (1, H, W) for all images.
        floor: smallest gain that counts, (B,).
    """
    labels = None if index is None else index.to(residual.dtype)
    best, factors, block = torch.zeros_like(residual[:, 0]), _scatter(residual[0, 0]), 1
    scales, parts = [], []
    for scale in _scales(residual, labels):
        middles = _middles(best, scale.block)
        scale.gain.mul_(_middles(factors, scale.block))
        torch.maximum(middles, scale.gain, out=middles)
        scales.append(scale)
        # in a region of one pixel all sizes gain the same: the first wins
        factors.mul_(1.0 - _SCATTER)
    for sigma, side, gain, colors in scales:
        while block < side:
            best, block = _halve_by_maximum(best), 2 * block
        highest = _pool(best, round(_RADIUS * sigma / block))[:, : gain.shape[1], : gain.shape[2]]
        is_highest = (gain >= highest) & (gain > floor.to(gain)[:, None, None])
        image, rows, columns = torch.nonzero(is_highest, as_tuple=True)
        means = (torch.stack([columns, rows], -1) + 0.5).to(gain.dtype) * block
        colors_there = colors[image, :, rows, columns]
        parts.append((image, gain[is_highest], means, means.new_full((len(means),), sigma), colors_there))
    return tuple(torch.cat(columns) for columns in zip(*parts, strict=True))


def _scales(residual: Tensor, labels: Tensor | None) -> Iterator[_Scale]:
    """Evaluate each size of Gaussians whose blocks are not larger than the images."""
    pixels = torch.cat([residual, torch.ones_like(residual[:, :1])], 1)
    for block, sigmas in _SIGMAS.items():
        if min(residual.shape[2:]) < block:
            return
        planes = _average(pixels, labels, block)
        middle_labels = None if labels is None else _middles(labels, block).contiguous()
        for sigma in sigmas:
            gain, colors = _gains(planes, middle_labels, sigma / block)
            yield _Scale(sigma, block, gain.mul_(block**2), colors)


def _scatter(plane: Tensor) -> Tensor:
    """Return factors just below 1 that differ between pixels, so that maxima of a flat error lie apart."""
    # steps of a sequence of low discrepancy: the pixels with the largest factors are spread over the plane
    row, column = (
        (step * torch.arange(length, device=plane.device, dtype=torch.float64)).frac().to(plane.dtype)
        for step, length in zip((0.7548776662466927, 0.5698402909980532), plane.shape, strict=True)
    )
    return (row[:, None] + column).frac_().mul_(-_SCATTER).add_(1.0)


def _middles(planes: Tensor, block: int) -> Tensor:
    """Return a view of the middle pixel of each whole block of (..., H, W): the last of the four around the middle."""
    height, width = (length // block * block for length in planes.shape[-2:])
    return planes[..., block // 2 : height : block, block // 2 : width : block]


def _average(planes: Tensor, labels: Tensor | None, block: int) -> Tensor:
    """Return the means of whole blocks of (B, K, H, W); their side is a power of 2.

    Pixels whose label differs from that of the block's middle count as 0.
    """
    if labels is not None and block > 1:
        if planes.is_cpu:
            from .pursuit_loops import average  # loads numba

            return average(planes, labels, block)
        middles = _middles(labels, block)
        height, width = (length * block for length in middles.shape[1:])
        blocks = labels[:, :height, :width].unflatten(2, (-1, block)).unflatten(1, (-1, block))
        is_same = (blocks == middles[:, :, None, :, None]).view(-1, 1, height, width)
        planes = planes[..., :height, :width] * is_same
    while block > 1:
        planes, block = halve(planes), block // 2
    return planes


def _gains(planes: Tensor, labels: Tensor | None, sigma: float) -> tuple[Tensor, Tensor]:
    """Return gain (B, H, W) and colours of Gaussians at the pixels of planes, (B, C + 1, H, W).

    The last plane has the pixels' weights. Filters run along columns, then along rows, each over pixels of the same
    label only. So a Gaussian covers a pixel of its region only if the pixel of that column in the
    Gaussian's row is in the region too.
    """
    arguments = planes, labels, sigma, math.ceil(_REACH * sigma)
    if not takes_triton(planes):
        from .pursuit_loops import gains  # loads numba

        return gains(*arguments)
    from .pursuit_cuda import blur  # loads triton

    blurred = blur(*arguments)
    colors = blurred[:, :-1] / blurred[:, -1:]
    return (blurred[:, :-1] * colors).sum(1), colors


def _pool(planes: Tensor, radius: int) -> Tensor:
    """Return the largest value of each square of side 2 radius + 1, of planes (B, H, W)."""
    if not planes.is_cpu:
        return max_pool2d(planes, 2 * radius + 1, 1, radius)
    # torch's pooling takes six times as long
    planes = pad(planes, [radius] * 4)
    for dim in (1, 2):
        length = planes.shape[dim] - 2 * radius
        planes = functools.reduce(torch.maximum, (planes.narrow(dim, start, length) for start in range(2 * radius + 1)))
    return planes


def _halve_by_maximum(planes: Tensor) -> Tensor:
    """Return the largest value of each block of 2 x 2; no value is negative, and the last blocks may be smaller."""
    planes = pad(planes, [0, planes.shape[2] % 2, 0, planes.shape[1] % 2])
    rows = torch.maximum(planes[:, ::2], planes[:, 1::2])
    return torch.maximum(rows[..., ::2], rows[..., 1::2])
