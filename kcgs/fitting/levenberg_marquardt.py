"""The last digits of a fit: every parameter of a small flat scene, by Levenberg-Marquardt."""

from __future__ import annotations

import math
import time
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from kcgs.functional import RegionMap, edge_band, region_splat
from kcgs.nn import GaussianField
from kcgs.scene import Scene

from .colors import is_better
from .frame import move

# a Gaussian as wide as 100 diagonals is constant over the image to 2.6e-6 (root mean square, 111 dB)
_SIGMA_LIMITS = (0.05, 100.0)  # pixels, diagonals
_CENTRE_DIAGONALS = 3.0
_FEATURES = 6
_CHUNK_ELEMENTS = 1 << 17
# on the pie colours grow to 330 at 1e-11 and to 90 at 1e-9, which costs 0.01 dB
_COLOR_COST = 1e-9
# squares of lesser weights are subnormal numbers, which are slow
_LEAST_WEIGHT = 1e-40
_LARGEST_SQUARE = 200.0
_LONGEST_STEP = 2.0
_LEAST_DAMPING, _MOST_DAMPING = 1e-13, 1e8
_LEAST_GAIN, _PATIENCE = 1e-4, 4
# share of the pixels: charts have 1.00, the flattest of 65 photographs 0.29
_FLAT_SHARE, _FLAT_ERROR = 0.8, 1.5 / 255
_FEW_GAUSSIANS = 64
_FLAT_SAMPLES = 1 << 16


@torch.no_grad()
def levenberg_marquardt(
    scene: Scene,
    image: Tensor,
    *,
    max_steps: int = 100,
    max_seconds: float = 10.0,
    cutoff: float = 0.0,
    backend: str = "auto",
) -> Scene:
    """Fit all parameters of a small scene to the last digit, by Levenberg-Marquardt in float64; see docs/fitting.md.

    Returns the scene itself where the squared error, rendered in its dtype, did not fall, or rose once clipped.

    Source: Golub and Pereyra, "The differentiation of pseudo-inverses and nonlinear least squares problems whose
    variables separate", 1973; Marquardt, "An algorithm for least-squares estimation of nonlinear parameters", 1963.
    """
    start = time.perf_counter()
    field, regions = scene.field, scene.regions
    whole = [t.detach().clone() for t in (field.means, field.cholesky, field.merged_colors())]
    ids = None if regions is None else field.region_ids
    settings = {"size": field.size, "cutoff": cutoff, "backend": backend}
    render = partial(region_splat, region_ids=ids, regions=regions, **settings)  # type: ignore[arg-type]
    before = render(*whole)
    kept = _bounded(whole[0].double(), whole[1].double(), field.size)
    flat = _sheets(*kept, field, regions)
    groups = _groups(_patches(field, image, regions), field.num_gaussians)
    for done, (members, patches) in enumerate(groups):
        deadline = time.perf_counter() + (start + max_seconds - time.perf_counter()) / (len(groups) - done)
        colors = whole[2][members].double()
        states = [
            _measure(patches, means[members], cholesky[members], colors, cutoff) for means, cholesky in (kept, flat)
        ]
        state = _descend(patches, min(states, key=lambda s: s.cost), field.size, cutoff, max_steps, deadline)
        # the colours that suit the geometry as it is kept
        means, cholesky = state.means.to(image.dtype).double(), state.cholesky.to(image.dtype).double()
        state = _measure(patches, means, cholesky, state.colors, cutoff)
        for tensor, value in zip(whole, state[:3], strict=True):
            tensor[members] = value.to(image.dtype)
    if not is_better(render(*whole), before, image):
        return scene
    means, cholesky, colors = whole
    return Scene(GaussianField(means, cholesky, colors, field.region_ids, size=field.size), regions, scene.metadata)


def _bounded(means: Tensor, cholesky: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Keep centres within 3 diagonals of the image, and scales within `_SIGMA_LIMITS`."""
    diagonal = math.hypot(*size)
    least, most = _SIGMA_LIMITS[0], _SIGMA_LIMITS[1] * diagonal
    l11, l21, l22 = cholesky.unbind(-1)
    # both numbers of the first column alike, so that the slope stays
    shrink = (most / torch.maximum(l11, l21.abs())).clamp_max(1.0)
    factors = [(l11 * shrink).clamp(least, most), l21 * shrink, l22.clamp(least, most)]
    extent, margin = means.new_tensor(size[::-1]), _CENTRE_DIAGONALS * diagonal
    return means.clamp(torch.full_like(extent, -margin), extent + margin), torch.stack(factors, -1)


def _sheets(means: Tensor, cholesky: Tensor, field: GaussianField, regions: RegionMap | None) -> tuple[Tensor, Tensor]:
    """Make the largest Gaussian of each region constant: where flat regions end, if slow steps do not get stuck."""
    means, cholesky = means.clone(), cholesky.clone()
    sigma = _SIGMA_LIMITS[1] * math.hypot(*field.size)
    index, index_map = torch.zeros_like(means[:, 0]), means.new_zeros(field.size)
    if regions is not None and field.region_ids is not None:
        index, index_map = regions.index_of(field.region_ids), regions.index[0]
    area = cholesky[:, 0] * cholesky[:, 2]
    for region in index[index >= 0].unique().tolist():
        inside = (index_map == region).nonzero().double()
        if len(inside):
            largest = torch.where(index == region, area, -1.0).argmax()
            means[largest] = inside.mean(0).flip(0) + 0.5
            cholesky[largest] = cholesky.new_tensor([sigma, 0.0, sigma])
    return means, cholesky


class _Patch(NamedTuple):
    """Pixels that see the same Gaussians."""

    members: Tensor  # [n] which
    points: Tensor  # [2, P] centres of the pixels
    target: Tensor  # [C, P]
    shares: Tensor | None  # [n, P] memberships; None: all one


def _patches(field: GaussianField, image: Tensor, regions: RegionMap | None) -> list[_Patch]:
    """Sort the pixels by the regions that have Gaussians and a weight there."""
    target = image.flatten(1).double()
    places = torch.arange(target.shape[1], device=image.device)
    points = torch.stack([places % image.shape[2] + 0.5, places // image.shape[2] + 0.5]).double()
    if regions is None or field.region_ids is None:
        return [_Patch(torch.arange(field.num_gaussians, device=image.device), points, target, None)]
    index = regions.index_of(field.region_ids)
    pattern = torch.zeros_like(places)
    supports = []
    for region in index[index >= 0].unique().tolist():
        weights = regions.weights(int(regions.ids[region])).flatten()
        support = weights.nonzero().flatten()
        supports.append(((index == region).nonzero().flatten(), support, weights[support]))
        pattern = torch.unique(2 * pattern + (weights > 0), return_inverse=True)[1]
    patches = []
    for pixels in pattern.argsort(stable=True).split(pattern.bincount().tolist()):
        seen = [s for s in supports if bool(torch.isin(pixels[0], s[1]))]
        if seen:
            shares = [w[torch.searchsorted(s, pixels)].expand(len(g), -1) for g, s, w in seen]
            members, share = torch.cat([s[0] for s in seen]), torch.cat(shares)
            whole = bool((share == 1).all())
            patches.append(_Patch(members, points[:, pixels], target[:, pixels], None if whole else share))
    return patches


def _groups(patches: list[_Patch], count: int) -> list[tuple[Tensor, list[_Patch]]]:
    """Split into Gaussians that share no pixel with others, and their patches, numbered within the group."""
    if not patches:
        return []
    group = torch.arange(count, device=patches[0].members.device)
    for patch in patches:
        joined = torch.isin(group, group[patch.members])
        group[joined] = group[joined].min()
    result = []
    for name in group[torch.cat([patch.members for patch in patches])].unique().tolist():
        members = (group == name).nonzero().flatten()
        inside = [patch for patch in patches if int(group[patch.members[0]]) == name]
        result.append((members, [c._replace(members=torch.searchsorted(members, c.members)) for c in inside]))
    return result


class _State(NamedTuple):
    """Parameters, and what the sum of squares around them is made of.

    The features of a Gaussian, s w (1, z1, z2, z1^2, z1 z2, z2^2), are the derivatives of what it paints by its
    colour, by d and by K, but for the factor c: nothing that is kept grows with the pixels.
    """

    means: Tensor  # [N, 2]
    cholesky: Tensor  # [N, 3]
    colors: Tensor  # [N, C], the best for this geometry
    gram: Tensor  # [6, N, 6, N] products of features, summed over pixels
    moments: Tensor  # [6, N, C] products of features and residual
    cost: float  # sum of squared residuals, and what the colours are charged


def _features(patch: _Patch, part: slice, means: Tensor, cholesky: Tensor, cutoff: float) -> Tensor:
    """Evaluate the features of a patch's Gaussians at some of its pixels, (6, n, p)."""
    (x, y), (l11, l21, l22) = means[patch.members].T[..., None], cholesky[patch.members].T[..., None]
    z1 = (patch.points[0, part] - x) / l11
    z2 = (patch.points[1, part] - y - l21 * z1) / l22
    weight = torch.exp(-0.5 * (z1 * z1 + z2 * z2).clamp_max(_LARGEST_SQUARE))
    weight = torch.where(weight >= max(cutoff, _LEAST_WEIGHT), weight, 0.0)
    if patch.shares is not None:
        weight = weight * patch.shares[:, part]
    first, second = weight * z1, weight * z2
    return torch.stack([weight, first, second, first * z1, first * z2, second * z2])


def _measure(patches: list[_Patch], means: Tensor, cholesky: Tensor, colors: Tensor, cutoff: float) -> _State:
    """Sum over the pixels, a chunk at a time, and move the colours to the best."""
    count = len(colors)
    gram = colors.new_zeros(_FEATURES * count, _FEATURES * count)
    moments = colors.new_zeros(_FEATURES * count, colors.shape[1])
    ridge = _COLOR_COST * sum(patch.points.shape[1] for patch in patches)
    cost = ridge * float(colors.square().sum())
    for patch in patches:
        rows = (torch.arange(_FEATURES, device=colors.device)[:, None] * count + patch.members).flatten()
        products, sums = colors.new_zeros(len(rows), len(rows)), colors.new_zeros(len(rows), colors.shape[1])
        step = max(1, _CHUNK_ELEMENTS // len(rows))
        for begin in range(0, patch.points.shape[1], step):
            part = slice(begin, begin + step)
            features = _features(patch, part, means, cholesky, cutoff)
            residual = patch.target[:, part] - colors[patch.members].T @ features[0]
            features = features.flatten(0, 1)
            products.addmm_(features, features.T)
            sums.addmm_(features, residual.T)
            cost += float(residual.square().sum())
        gram[rows[:, None], rows] += products
        moments[rows] += sums
    # of the cost with the charge; what follows from other colours is linear in them, or quadratic: no second pass
    gram.diagonal()[:count] += ridge
    moments[:count] -= ridge * colors
    change = torch.linalg.solve(gram[:count, :count], moments[:count])
    cost -= float((moments[:count] * change).sum())
    moments -= gram[:, :count] @ change
    gram, moments = gram.view(_FEATURES, count, _FEATURES, count), moments.view(_FEATURES, count, -1)
    return _State(means, cholesky, colors + change, gram, moments, cost)


def _step(state: _State, damping: float) -> tuple[Tensor, Tensor]:
    """Solve for the steps of geometry, (5, N) as d1, d2, k11, k21, k22, and of the colours with them, (N, C)."""
    cross = state.gram[0, :, 1:].flatten(1)  # [N, 5N]
    follow = torch.linalg.solve(state.gram[0, :, 0], cross)
    alike = (state.colors @ state.colors.T).repeat(_FEATURES - 1, _FEATURES - 1)
    shape = state.gram[1:, :, 1:].reshape(cross.shape[1], -1)
    matrix, scale = (shape - cross.T @ follow) * alike, (shape * alike).diagonal()
    # the second and third term: a Gaussian that no pixel sees has a row of zeros
    matrix.diagonal().add_(damping * scale + _LEAST_DAMPING * scale.max() + _LEAST_WEIGHT)
    slope = (state.moments[1:] * state.colors).sum(-1).flatten()
    step = torch.linalg.solve(matrix, slope).clamp(-_LONGEST_STEP, _LONGEST_STEP).view(_FEATURES - 1, -1)
    return step, -follow @ (step[..., None] * state.colors).flatten(0, 1)


def _descend(
    patches: list[_Patch], state: _State, size: tuple[int, int], cutoff: float, max_steps: int, deadline: float
) -> _State:
    """Take steps that lower the cost, a more careful one after each that would not."""
    damping, small = 1e-2, 0
    for _ in range(max_steps):
        if small >= _PATIENCE or damping > _MOST_DAMPING or time.perf_counter() > deadline:
            break
        step, colors = _step(state, damping)
        moved = move(state.means, state.cholesky, step.T, exact=False)
        trial = _measure(patches, *_bounded(*moved, size), state.colors + colors, cutoff)
        if trial.cost < state.cost:
            small = small + 1 if trial.cost > (1 - _LEAST_GAIN) * state.cost else 0
            state, damping = trial, max(damping / 5, _LEAST_DAMPING)
        else:
            damping *= 4
    return state


def is_flat(image: Tensor, regions: RegionMap | None, num_gaussians: int) -> bool:
    """Say whether :func:`levenberg_marquardt` pays on a scene: few Gaussians, and an image smooth inside its regions.

    At most 64 Gaussians, no fewer than regions, and 80 % of the pixels (of about 65,536 on a grid) farther than 2
    pixels from a contour within 1.5 / 255 of the best quadratic in x and y of their region. Charts have 100 %, 65
    photographs at most 29 % (BSDS with human labels 29, DAVIS 0.9, Kodak without a map 0.4).
    """
    size = (image.shape[1], image.shape[2])
    if not (1 if regions is None else regions.num_regions) <= num_gaussians <= _FEW_GAUSSIANS:
        return False
    index = torch.zeros(size, dtype=torch.long, device=image.device)
    if regions is not None:
        index = torch.where(edge_band(regions.labels, 2), -1, regions.index_of(regions.labels))
    stride = max(1, math.isqrt(size[0] * size[1] // _FLAT_SAMPLES))
    y, x = (index[::stride, ::stride] >= 0).nonzero().T * stride
    near = 0
    for region in index[y, x].unique():
        v, u = (index[::stride, ::stride] == region).nonzero().T * stride
        values = image[:, v, u].T.double()
        u, v = ((t - t.double().mean()) / max(size) for t in (u, v))
        features = torch.stack([torch.ones_like(u), u, v, u * u, u * v, v * v], -1)
        best = torch.linalg.pinv(features.T @ features, hermitian=True) @ (features.T @ values)
        near += int(((features @ best - values).abs().amax(1) <= _FLAT_ERROR).sum())
    return len(x) > 0 and near >= _FLAT_SHARE * len(x)
