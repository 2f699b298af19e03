"""Edit a scene by region: move, recolour, delete, cut out, put on another background."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcgs._check import check_floating, check_image, check_size
from kcgs.functional import RegionMap

from .field import GaussianField
from .renderer import RegionSplatRenderer

# standard deviation of a Gaussian that is flat over the picture, in its longer sides: 1 to 3 in 10^7
_FLAT = 1e3


class EditedScene(NamedTuple):
    """A field and the regions to draw it with; the renderer takes the pair as it is."""

    field: GaussianField
    regions: RegionMap


def move_region(
    field: GaussianField, regions: RegionMap | Tensor, region_id: int, offset: Sequence[float]
) -> EditedScene:
    """Move a region: its Gaussians and its labels, over whatever lies there.

    Convention: pixels that it leaves take the label of the nearest pixel of another region (Euclidean; of equal
    distances, the smallest id), and show what the Gaussians of that region paint there; pixels that leave the picture
    are lost. A region that is covered whole is no region any more, and its Gaussians draw nothing. Where pairs of
    regions have widths, the contour with a region that it did not touch before takes the mean width of those it had.

    Args:
        field: unbatched, with region ids.
        regions: one map of the field's size, not a resized one.
        region_id: an id in the map.
        offset: (dx, dy) in pixels, whole; with ``supersample`` k, whole multiples of 1/k.

    Returns:
        New field (no graph) and map.

    Raises:
        TypeError: wrong types.
        ValueError: a batched field or map, one of another size, an unknown id, the only region, an offset between
            labels.

    Example:
        >>> labels = torch.tensor([[0, 7, 7, 0, 0, 0]])
        >>> field = GaussianField.random(5, (1, 6), regions=labels, seed=0)
        >>> move_region(field, labels, 7, (2, 0)).regions.labels
        tensor([[0, 0, 0, 7, 7, 0]])
    """
    regions = _check_editable(field, regions)
    region_id = _check_region(regions, region_id)
    steps = _check_offset(offset, regions.supersample)
    grid = _grid(regions)
    inside = grid == region_id
    labels = _fill(grid, inside)
    rows, cols = (_overlap(n, step) for n, step in zip(grid.shape, steps[::-1], strict=True))
    landed = torch.zeros_like(inside)
    landed[rows[1], cols[1]] = inside[rows[0], cols[0]]
    labels[landed] = region_id

    moved = _copy(field)
    with torch.no_grad():
        shift = moved.means.new_tensor(steps) / regions.supersample
        moved.means += torch.where((_ids(moved) == region_id)[:, None], shift, 0.0)
    return EditedScene(moved, _rebuilt(regions, labels, _moved_widths(regions, grid, region_id)))


def recolor_region(
    field: GaussianField, region_id: int, gain: Tensor | float, bias: Tensor | float | None = None
) -> GaussianField:
    r"""Change the colours of a region, c' = gain c + bias, exactly so in the picture.

    Convention: a gain acts on the colours of the Gaussians. A bias does not (pixels are sums of Gaussians, not means):
    it is one more Gaussian of the region, flat over the whole picture.

    Args:
        field: unbatched, with region ids.
        region_id: the id of some of its Gaussians.
        gain: a number, one for each channel :math:`(C)`, or a matrix :math:`(C, C)`.
        bias: a number, or one for each channel :math:`(C)`; None: none, and no Gaussian more.

    Returns:
        A new field (no graph).

    Raises:
        TypeError: wrong types.
        ValueError: a batched field, an id that none of its Gaussians has, wrong shapes, values that are not finite.

    Example:
        >>> labels = torch.zeros(4, 6, dtype=torch.long)
        >>> field = GaussianField.random(5, (4, 6), regions=labels, seed=0)
        >>> negative = recolor_region(field, 0, -1.0, 1.0)
        >>> pictures = [RegionSplatRenderer()(f, labels) for f in (field, negative)]
        >>> torch.allclose(sum(pictures), torch.ones(3, 4, 6), atol=1e-5)
        True
    """
    ids = _ids(_check_field(field))
    _check_id(region_id)
    chosen = ids == region_id
    if not chosen.any():
        raise ValueError(f"region_id must be one of the field's; got {region_id}")
    channels = field.colors.shape[-1]
    matrix = _color_tensor("gain", gain, field.colors, [(), (channels,), (channels, channels)])
    colors = field.colors.detach().clone()
    colors[chosen] = colors[chosen] @ matrix.T if matrix.ndim == 2 else colors[chosen] * matrix
    result = _copy(field, colors=colors)
    if bias is None:
        return result
    flat = _color_tensor("bias", bias, field.colors, [(), (channels,)]).expand(channels)
    return _with_flat(result, region_id, flat)


def delete_region(field: GaussianField, regions: RegionMap | Tensor, region_id: int) -> EditedScene:
    """Delete a region: its Gaussians go, its pixels fall to its neighbours.

    Convention: each of its pixels takes the label of the nearest pixel that stays (Euclidean; of equal distances, the
    smallest id), and shows what the Gaussians of that region paint there: nothing, black, where they do not reach.
    Where pairs of regions have widths, contours between regions that did not touch before are hard.

    Args:
        field: unbatched, with region ids.
        regions: one map of the field's size, not a resized one.
        region_id: an id in the map.

    Returns:
        New field (no graph) and map.

    Raises:
        TypeError: wrong types.
        ValueError: a batched field or map, one of another size, an unknown id, the only region.

    Example:
        >>> labels = torch.tensor([[0, 0, 3, 3, 3, 5]])
        >>> field = GaussianField.random(9, (1, 6), regions=labels, seed=0)
        >>> delete_region(field, labels, 3).regions.labels
        tensor([[0, 0, 0, 0, 5, 5]])
    """
    regions = _check_editable(field, regions)
    region_id = _check_region(regions, region_id)
    grid = _grid(regions)
    labels = _fill(grid, grid == region_id)
    return EditedScene(field.subset(_ids(field) != region_id), _rebuilt(regions, labels, regions.softness))


def extract_region(
    field: GaussianField, regions: RegionMap | Tensor, region_id: int, size: tuple[int, int] | None = None
) -> Tensor:
    r"""Cut a region out of the picture, with its share of each pixel as alpha.

    Convention: colours are straight, not multiplied by alpha, and not clamped: what the region paints where it has the
    pixel to itself, also under a soft contour. They are 0 where alpha is. Shares of all regions add up to one, so that
    the sum of alpha times colour over all of them is the picture. Differentiable, as the renderer is.

    Args:
        field: unbatched, with region ids.
        regions: one map of the field's size or of `size`.
        region_id: an id in the map.
        size: (height, width) of the result; None: the field's.

    Returns:
        RGBA, :math:`(4, H, W)`; :math:`(C + 1, H, W)` for C channels.

    Raises:
        TypeError: wrong types.
        ValueError: a batched field or map, one of another size, an unknown id.

    Example:
        >>> labels = torch.tensor([[0, 0, 3, 3, 3, 5]])
        >>> field = GaussianField.random(9, (1, 6), regions=labels, seed=0)
        >>> extract_region(field, labels, 3)[3].tolist()
        [[0.0, 0.0, 1.0, 1.0, 1.0, 0.0]]
    """
    target = _check_field(field).size if size is None else check_size("size", size)
    regions = _check_scene(field, regions, target)
    region_id = _check_region(regions, region_id)
    share = _share(regions.resize(target), [region_id], field.colors)
    # drawn alone and not confined, which is the colour itself: nothing is divided by a small alpha
    colors = RegionSplatRenderer()(_part(field, _ids(field) == region_id), None, target)
    return torch.cat([torch.where(share > 0, colors, 0.0), share[None]])


def replace_background(
    field: GaussianField, regions: RegionMap | Tensor, region_ids: int | Iterable[int], background: Tensor
) -> Tensor:
    r"""Draw the picture with another background in place of some regions, at the size of that background.

    Convention: the background gets the share of each pixel that those regions had, so that soft contours blend with it
    as they did with them. Not clamped. Differentiable in the field and in the background.

    Args:
        field: unbatched, with region ids.
        regions: one map of the field's size or of the background's.
        region_ids: the regions that make the background now: an id or several, each in the map.
        background: :math:`(C, H, W)`, as many channels as the field has; any size.

    Returns:
        Picture, :math:`(C, H, W)`.

    Raises:
        TypeError: wrong types.
        ValueError: a batched field or map, one of another size, an unknown id, another number of channels.

    Example:
        >>> labels = torch.tensor([[0, 0, 3, 3, 3, 5]])
        >>> field = GaussianField.random(9, (1, 6), regions=labels, seed=0)
        >>> replace_background(field, labels, [0, 5], torch.full((3, 1, 6), 0.25))[0, 0, [0, 1, 5]].tolist()
        [0.25, 0.25, 0.25]
    """
    background = check_image("background", background)
    channels = field.colors.shape[-1]
    if background.ndim != 3 or background.shape[0] != channels:
        raise ValueError(f"background must have shape ({channels}, H, W); got {tuple(background.shape)}")
    target = (background.shape[-2], background.shape[-1])
    regions = _check_scene(field, regions, target)
    gone = [_check_region(regions, r) for r in ([region_ids] if isinstance(region_ids, int) else region_ids)]
    stays = ~torch.isin(_ids(field), torch.tensor(gone, dtype=torch.int64, device=field.means.device))
    picture: Tensor = RegionSplatRenderer()(_part(field, stays), regions, target)
    return picture + _share(regions.resize(target), gone, field.colors) * background.to(picture)


def _check_field(field: GaussianField) -> GaussianField:
    if not isinstance(field, GaussianField):
        raise TypeError(f"field must be a GaussianField; got {type(field).__name__}")
    if field.means.ndim != 2:
        raise ValueError(f"field must not be batched; got means of shape {tuple(field.means.shape)}")
    if field.region_ids is None:
        raise ValueError("field must have region_ids; call field.assign_regions(regions)")
    return field


def _check_scene(field: GaussianField, regions: RegionMap | Tensor, target: tuple[int, int]) -> RegionMap:
    _check_field(field)
    if isinstance(regions, Tensor):
        regions = RegionMap.from_labels(regions)
    elif not isinstance(regions, RegionMap):
        raise TypeError(f"regions must be a RegionMap or a label map Tensor; got {type(regions).__name__}")
    if regions.labels.ndim != 2 or regions.size not in (field.size, target):
        allowed = f"{field.size}" if target == field.size else f"{field.size} or {target}"
        raise ValueError(f"regions must be one map of the size {allowed}; got {tuple(regions.labels.shape)}")
    return regions


def _check_editable(field: GaussianField, regions: RegionMap | Tensor) -> RegionMap:
    regions = _check_scene(field, regions, field.size)
    if regions.resized:
        raise ValueError("regions must not be resized: edit the map at its own size, then resize it")
    if regions.num_regions == 1:
        raise ValueError("regions must hold another region, which takes over pixels; got 1 region")
    return regions


def _check_id(region_id: object) -> int:
    if isinstance(region_id, bool) or not isinstance(region_id, int):
        raise TypeError(f"region_id must be an integer; got {region_id!r}")
    return region_id


def _check_region(regions: RegionMap, region_id: object) -> int:
    region = _check_id(region_id)
    if not (regions.ids == region).any():
        raise ValueError(f"region_id must be one of the {regions.num_regions} ids in the map; got {region}")
    return region


def _check_offset(offset: Sequence[float], supersample: int) -> tuple[int, int]:
    """Return the offset in labels."""
    if len(offset) != 2:
        raise ValueError(f"offset must be (dx, dy); got {offset!r}")
    steps = [float(d) * supersample for d in offset]
    if any(step != step or abs(step) > 1e8 or abs(step - round(step)) > 1e-6 for step in steps):
        unit = "1 pixel" if supersample == 1 else f"1/{supersample} pixel, the spacing of the labels"
        raise ValueError(f"offset must be whole multiples of {unit}; got {offset!r}")
    return round(steps[0]), round(steps[1])


def _color_tensor(name: str, value: Tensor | float, colors: Tensor, shapes: list[tuple[int, ...]]) -> Tensor:
    if isinstance(value, Tensor):
        tensor = check_floating(name, value).detach().to(colors)
    elif isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{name} must be a number or a Tensor; got {value!r}")
    else:
        tensor = check_floating(name, colors.new_tensor(value))
    if tuple(tensor.shape) not in shapes:
        raise ValueError(f"{name} must have shape {' or '.join(map(str, shapes))}; got {tuple(tensor.shape)}")
    return tensor


def _ids(field: GaussianField) -> Tensor:
    assert field.region_ids is not None
    return field.region_ids


def _copy(field: GaussianField, colors: Tensor | None = None) -> GaussianField:
    copy = field.subset(torch.ones(len(field), dtype=torch.bool, device=field.means.device))
    if colors is not None:
        with torch.no_grad():
            copy.colors.copy_(colors)
    return copy


def _part(field: GaussianField, mask: Tensor) -> GaussianField:
    """Take the Gaussians that `mask` selects, in the graph."""
    opacities = None if field.opacities is None else field.opacities[mask]
    means, cholesky, colors = (t[mask] for t in (field.means, field.cholesky, field.colors))
    return GaussianField(means, cholesky, colors, _ids(field)[mask], opacities, size=field.size)


def _with_flat(field: GaussianField, region_id: int, color: Tensor) -> GaussianField:
    height, width = field.size
    sigma = _FLAT * max(height, width)
    rows = [(field.means, [width / 2, height / 2]), (field.cholesky, [sigma, 0.0, sigma]), (field.colors, color)]
    means, cholesky, colors = (torch.cat([t.detach(), torch.as_tensor(row).to(t)[None]]) for t, row in rows)
    ids = torch.cat([_ids(field), _ids(field).new_tensor([region_id])])
    opacities = None
    if field.opacities is not None:
        opacities = torch.cat([field.opacities.detach(), field.opacities.new_ones(1)])
    return GaussianField(means, cholesky, colors, ids, opacities, size=field.size)


def _grid(regions: RegionMap) -> Tensor:
    return regions.fine_labels


def _share(regions: RegionMap, region_ids: Iterable[int], like: Tensor) -> Tensor:
    """Share of each pixel that some regions have, (H, W)."""
    total = torch.zeros(regions.size, dtype=torch.float64, device=like.device)
    for region in regions.index_of(torch.tensor(sorted(set(region_ids)), device=regions.ids.device)).tolist():
        if region >= 0:  # a small one may be gone from a small map
            total += regions.membership.weights(0, region, torch.float64)
    return total.clamp_max(1.0).to(like.dtype)


def _fill(labels: Tensor, hole: Tensor) -> Tensor:
    """Give pixels of the hole the label of the nearest other pixel, of equals the smallest."""
    from scipy.ndimage import distance_transform_edt

    # the nearest pixel touches the hole: one step from it towards any pixel of the hole is nearer
    lines = [hole.any(axis).nonzero().flatten() for axis in (1, 0)]
    rows, cols = (slice(max(0, int(at[0]) - 1), int(at[-1]) + 2) for at in lines)
    part, inside = labels[rows, cols], hole[rows, cols]
    touching = torch.nn.functional.max_pool2d(inside[None].float(), 3, 1, 1)[0] > 0
    best = torch.full(part.shape, torch.inf, dtype=torch.float64)
    filled = part.cpu().clone()
    for region in part[touching & ~inside].unique().tolist():
        distance = torch.from_numpy(distance_transform_edt((part != region).cpu().numpy()))
        nearer = inside.cpu() & (distance < best)
        best[nearer], filled[nearer] = distance[nearer], region
    result = labels.clone()
    result[rows, cols] = filled.to(labels.device)
    return result


def _overlap(length: int, step: int) -> tuple[slice, slice]:
    """Which places of an axis stay on it, before and after a step."""
    step = max(-length, min(length, step))
    return slice(max(0, -step), length - max(0, step)), slice(max(0, step), length - max(0, -step))


def _moved_widths(regions: RegionMap, grid: Tensor, region_id: int) -> float | Mapping[tuple[int, int], float]:
    widths = regions.softness
    if isinstance(widths, float):
        return widths
    inside = grid == region_id
    touched: set[int] = set()
    for one, other in (((slice(1, None),), (slice(-1),)), ((..., slice(1, None)), (..., slice(-1)))):
        across = inside[one] ^ inside[other]
        touched |= {*grid[one][across].tolist(), *grid[other][across].tolist()} - {region_id}
    had = [widths.get((region_id, neighbour), 0.0) for neighbour in touched]
    usual = sum(had) / max(1, len(had))
    apart = {*regions.ids.tolist()} - {region_id} - touched
    new = {(min(region_id, far), max(region_id, far)): usual for far in apart}
    return {**new, **widths}


def _rebuilt(regions: RegionMap, labels: Tensor, softness: float | Mapping[tuple[int, int], float]) -> RegionMap:
    """Make a map of new labels, with the widths of the pairs that are left."""
    if isinstance(softness, Mapping):
        left = set(labels.unique().tolist())
        softness = {pair: width for pair, width in softness.items() if left.issuperset(pair)}
    return RegionMap.from_labels(labels, softness, supersample=regions.supersample)
