"""Move, recolour, delete and extract regions, and put other scenes behind them: a new scene each."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from kcgs.functional import RegionMap
from kcgs.nn import GaussianField
from kcgs.nn.field import join, scaled
from kcgs.scene import Scene

from .checks import (
    Fill,
    Numbers,
    check_editable,
    check_field,
    check_fill,
    check_ids,
    check_offset,
    check_scene,
    color_tensor,
    ids_of,
)
from .fill import fill_hole, grow

# standard deviation of a Gaussian that is flat over the image, in its longer sides: 1 to 3 in 10^7
_FLAT = 1e3
# a contour is cut at so many of its standard deviations
_CONTOUR_SIGMAS = 4.0


def move_region(
    scene: Scene, region_ids: int | Iterable[int], offset: Sequence[float], *, fill: Fill | None = "inpaint"
) -> Scene:
    """Move regions: their Gaussians and their labels, over whatever lies there.

    Convention: pixels that they leave take the label of the nearest pixel of another region, and are filled, see
    `fill`; pixels that leave the image are lost. A region that is covered whole, or leaves the image, is no region any
    more: its Gaussians are lost too. Where pairs of regions have widths, contours that are new take their mean.

    Args:
        scene: unbatched, with a map of its own size, not a resized one.
        region_ids: an id in the map, or several, which move together.
        offset: (dx, dy) in pixels, whole.
        fill: "inpaint": what is uncovered continues its surroundings smoothly, by Gaussians that are fitted there, some
            of them new, and so do 3 pixels around it, which have colours of the object; others change by a few
            hundredths. None: no fit; what is uncovered shows what the Gaussians of its new region paint there, streaks,
            or black.

    Returns:
        A new scene, without a graph.

    Raises:
        TypeError: wrong types.
        ValueError: a batch, no map or one of another size, an unknown id, all regions, an offset between pixels,
            another `fill`.

    Warns:
        UserWarning: the ids of regions that are lost.

    Example:
        >>> labels = torch.tensor([[0, 7, 7, 0, 0, 0]])
        >>> scene = Scene(GaussianField.random(5, (1, 6), regions=labels, seed=0), labels)
        >>> move_region(scene, 7, (2, 0)).regions.labels
        tensor([[0, 0, 0, 7, 7, 0]])
    """
    check_fill(fill)
    regions, chosen = check_editable(scene, region_ids)
    steps = check_offset(offset)
    inside = torch.isin(regions.labels, chosen)
    behind = nearest_labels(regions.labels, inside)
    landed, labels = shift_labels(regions.labels, inside, steps, behind)

    lost = regions.ids[~torch.isin(regions.ids, labels)].tolist()
    if lost:
        warnings.warn(f"regions {', '.join(map(str, lost))} are lost: covered, or out of the image", stacklevel=3)

    field = scene.field
    if fill is not None:
        field = _filled_behind(scene, regions.relabel(behind), inside, landed)
    moved = field.subset(torch.isin(ids_of(field), labels))
    with torch.no_grad():
        shift = moved.means.new_tensor(steps)
        moved.means += torch.where(torch.isin(ids_of(moved), chosen)[:, None], shift, 0.0)
    return Scene(moved, regions.relabel(labels, "mean"), scene.metadata)


def recolor_region(scene: Scene, region_ids: int | Iterable[int], gain: Numbers, bias: Numbers | None = None) -> Scene:
    r"""Change the colours of regions, c' = gain c + bias, exactly so in the image.

    Convention: a gain acts on the colours of the Gaussians. A bias does not (pixels are sums of Gaussians, not means):
    it is one more Gaussian per region, flat over the whole image.

    Args:
        scene: with region ids; of a batch, all images.
        region_ids: an id that some of its Gaussians have, or several.
        gain: a number, one for each channel :math:`(C)`, or a matrix :math:`(C, C)`: tensors, arrays or lists.
        bias: a number, or one for each channel :math:`(C)`; None: none, and no Gaussian more.

    Returns:
        A new scene, without a graph.

    Raises:
        TypeError, ValueError: an id that no Gaussian has, wrong types or shapes, values that are not finite.

    Example:
        >>> labels = torch.zeros(4, 6, dtype=torch.long)
        >>> scene = Scene(GaussianField.random(5, (4, 6), regions=labels, seed=0), labels)
        >>> negative = recolor_region(scene, 0, -1.0, 1.0)
        >>> torch.allclose(scene() + negative(), torch.ones(3, 4, 6), atol=1e-5)
        True
    """
    field = check_field(scene)
    wanted = check_ids(region_ids, ids_of(field), "Gaussians")
    chosen = torch.isin(ids_of(field), torch.tensor(wanted, device=field.means.device))
    channels = field.colors.shape[-1]
    matrix = color_tensor("gain", gain, field.colors, [(), (channels,), (channels, channels)])
    result = field.subset(torch.ones_like(chosen)) if field.means.ndim == 2 else field.image(slice(None))
    with torch.no_grad():
        colors = result.colors[chosen]
        result.colors[chosen] = colors @ matrix.T if matrix.ndim == 2 else colors * matrix
    if bias is not None:
        flat = color_tensor("bias", bias, field.colors, [(), (channels,)]).expand(channels)
        for region in wanted:
            result = _with_flat(result, region, flat)
    return Scene(result, scene.regions, scene.metadata)


def delete_region(scene: Scene, region_ids: int | Iterable[int], *, fill: Fill | None = "inpaint") -> Scene:
    """Delete regions: their Gaussians go, their pixels fall to their neighbours. Arguments: see :func:`move_region`.

    Convention: each of their pixels takes the label of the nearest pixel that stays, and is filled, see `fill` there.
    Where pairs of regions have widths, contours between regions that did not touch before are hard.

    Example:
        >>> labels = torch.tensor([[0, 0, 3, 3, 3, 5]])
        >>> scene = Scene(GaussianField.random(9, (1, 6), regions=labels, seed=0), labels)
        >>> delete_region(scene, 3).regions.labels
        tensor([[0, 0, 0, 0, 5, 5]])
    """
    check_fill(fill)
    regions, chosen = check_editable(scene, region_ids)
    hole = torch.isin(regions.labels, chosen)
    field = scene.field.subset(~torch.isin(ids_of(scene.field), chosen))
    rest = Scene(field, regions.relabel(nearest_labels(regions.labels, hole)), scene.metadata)
    return rest if fill is None else fill_hole(rest, hole, hole)


def extract_region(scene: Scene, region_ids: int | Iterable[int]) -> Scene:
    """Keep the Gaussians of some regions: the scene shows them where they were, and black elsewhere.

    The map stays whole, so that contours stay as they were: `num_regions` counts the others too, and the scene's repr
    says how many have no Gaussian. Arguments are those of :func:`move_region`; the map may be resized.
    :func:`render_region` gives regions with their share of each pixel as alpha.

    Example:
        >>> labels = torch.tensor([[0, 0, 3, 3, 3, 5]])
        >>> scene = Scene(GaussianField.random(9, (1, 6), regions=labels, seed=0), labels)
        >>> extract_region(scene, 3).field.region_ids.unique()
        tensor([3])
    """
    regions, chosen = check_scene(scene, region_ids)
    return Scene(scene.field.subset(torch.isin(ids_of(scene.field), chosen)), regions, scene.metadata)


def replace_background(scene: Scene, region_ids: int | Iterable[int], background: Scene) -> Scene:
    """Put another scene in place of some regions, stretched to the size of this one.

    Convention: the regions of the background, or it as one region, get ids above those of the scene. Where pairs of
    regions of the scene have widths, contours that are new take their mean.

    Args:
        scene: unbatched, with a map of its own size, not a resized one.
        region_ids: the regions that make the background now: an id in the map, or several.
        background: unbatched, with as many channels.

    Returns:
        A new scene, without a graph.

    Raises:
        TypeError, ValueError: as :func:`extract_region`; another number of channels.

    Example:
        >>> labels = torch.tensor([[0, 0, 3, 3, 3, 5]])
        >>> scene = Scene(GaussianField.random(9, (1, 6), regions=labels, seed=0), labels)
        >>> other = Scene(GaussianField.random(4, (2, 12), seed=1))
        >>> replace_background(scene, [0, 5], other).regions.labels
        tensor([[6, 6, 3, 3, 3, 6]])
    """
    regions, chosen = check_scene(scene, region_ids)
    if not isinstance(background, Scene):
        raise TypeError(f"background must be a Scene; got {type(background).__name__}")
    other, field = background.field, scene.field
    if other.means.ndim != 2 or other.colors.shape[-1] != field.colors.shape[-1]:
        raise ValueError(
            f"background must not be batched and have {field.colors.shape[-1]} channels; got colors of shape "
            f"{tuple(other.colors.shape)}"
        )
    first = int(regions.ids.max()) + 1
    inside = torch.isin(regions.labels, chosen)
    behind = torch.full_like(regions.labels, first)
    ids = torch.full_like(ids_of(field), first)[:1].expand(other.num_gaussians)
    if background.regions is not None and other.region_ids is not None:
        sampled = RegionMap.from_labels(background.regions.labels).resize(scene.size)
        behind, ids = sampled.labels.to(behind.device) + first, other.region_ids.to(behind.device) + first
    labels = torch.where(inside, behind, regions.labels)
    means, cholesky, colors = (t.to(field.means) for t in (*scaled(other, scene.size), other.merged_colors()))
    stays = field.subset(~torch.isin(ids_of(field), chosen))
    joined = join(stays, GaussianField(means, cholesky, colors, ids, size=scene.size))
    joined = joined.subset(torch.isin(ids_of(joined), labels))
    return Scene(joined, regions.relabel(labels, "mean"), scene.metadata)


def _with_flat(field: GaussianField, region_id: int, color: Tensor) -> GaussianField:
    height, width = field.size
    sigma = _FLAT * max(height, width)
    rows = [(field.means, [width / 2, height / 2]), (field.cholesky, [sigma, 0.0, sigma]), (field.colors, color)]
    lead = (*field.means.shape[:-2], 1)
    means, cholesky, colors = (torch.as_tensor(row).to(t).expand(*lead, -1) for t, row in rows)
    flat = GaussianField(means, cholesky, colors, ids_of(field).new_tensor(region_id).expand(lead), size=field.size)
    return join(field, flat)


def nearest_labels(labels: Tensor, hole: Tensor) -> Tensor:
    """Give pixels of the hole, (H, W) bool, the label of the nearest other pixel."""
    from scipy.ndimage import distance_transform_edt

    rows, cols = distance_transform_edt(hole.cpu().numpy(), return_distances=False, return_indices=True)
    return labels[torch.from_numpy(rows).long(), torch.from_numpy(cols).long()]


def shift_labels(labels: Tensor, inside: Tensor, offset: tuple[int, int], behind: Tensor) -> tuple[Tensor, Tensor]:
    """Move the labels inside a mask over those behind, (..., H, W); return where they land, and all labels."""
    dx, dy = (max(-length, min(step, length)) for length, step in zip(labels.shape[:-3:-1], offset, strict=True))
    landed = torch.nn.functional.pad(inside, (dx, -dx, dy, -dy))
    return landed, torch.where(landed, labels.roll((dy, dx), (-2, -1)), behind)


def _filled_behind(scene: Scene, behind: RegionMap, hole: Tensor, landed: Tensor) -> GaussianField:
    """Return the field, what is behind the regions that were in the hole filled where they have not landed again."""
    if not (hole & ~landed).any():
        return scene.field
    before = scene.regions
    assert before is not None
    widths = before.softness
    width = widths if isinstance(widths, float) else max(widths.values(), default=0.0)
    # through a soft contour one sees what is behind
    uncovered = grow(~landed, math.ceil(1.0 + _CONTOUR_SIGMAS * width))
    stays = ~torch.isin(ids_of(scene.field), before.labels[hole].unique())
    filled = fill_hole(Scene(scene.field.subset(stays), behind), hole, hole & uncovered).field
    return join(filled, scene.field.subset(~stays))
