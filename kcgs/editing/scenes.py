"""Move, recolour, delete and extract regions, and put other scenes behind them: each edit returns a new scene."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcgs._check import check_floating, check_number
from kcgs._image import LUMA
from kcgs._warn import warn_user
from kcgs.errors import InvalidArgument
from kcgs.functional import RegionMap
from kcgs.nn import GaussianField, join, scaled_gaussians
from kcgs.scene import Scene, check_scene, check_type

from .fill import fill_hole
from .masks import check_offset, dilate, nearest_labels, shift_labels
from .selection import members_of, select_regions, select_removable_regions, unique_region_ids

Numbers = Tensor | NDArray[Any] | Sequence[Any] | float

# standard deviation of a flat Gaussian, in longer sides of the image: its values differ by 3 in 10^7 at most
_FLAT_SIGMA = 1e3
# share of a region's pixels that are no brighter than those that get its new colour
_BRIGHT_SHARE = 0.9
# share of them that stay within [0, 1]: glints beyond may clip
_UNCLIPPED_SHARE = 0.995
# least share of the new colour that the former get, so that the latter stay
_LEAST_COLOR = 0.75
# their luma, at least, for contrast: in darker regions noise would be seen
_MIN_LUMA = 0.25
# standard deviations of a soft contour beyond which it is taken as 0 or 1
_CONTOUR_SIGMAS = 4.0


def move_region(scene: Scene, region_ids: int | Iterable[int], offset: Sequence[float], *, fill: bool = True) -> Scene:
    """Move regions: their Gaussians and their labels, over what lies there.

    Convention: pixels that the regions leave take the label of the nearest pixel of another region. Pixels that leave
    the image are lost. A region that is covered whole, or leaves the image, is lost with its Gaussians. Where the
    softness differs by pairs of regions, a new contour has their mean. :func:`kcgs.video.move_in_video` moves them in
    all frames of a video, and always fills what they leave.

    Args:
        scene: unbatched, with a map of its own size, not a resized one.
        region_ids: an id in the map, or several, which move together.
        offset: (dx, dy) in pixels, whole.
        fill: True: the uncovered pixels, and 6 pixels and narrow gaps around them, which have colours of the object,
            continue their surroundings like the places of the image that look most alike, by Gaussians that are fitted
            there, some of them new; other pixels change by a few hundredths. False: the uncovered pixels show what the
            Gaussians of their new region paint there, streaks or black.

    Returns:
        A new scene, without a graph.

    Raises:
        TypeError: wrong types.
        ValueError: a batch, no map or one of another size, an unknown id, all regions, an offset between pixels.

    Warns:
        UserWarning: regions are lost; it names their ids.

    Example:
        >>> labels = torch.tensor([[0, 7, 7, 0, 0, 0]])
        >>> scene = Scene(GaussianField.random(5, (1, 6), regions=labels, seed=0), labels)
        >>> move_region(scene, 7, (2, 0)).regions.labels
        tensor([[0, 0, 0, 7, 7, 0]])
    """
    selection = select_removable_regions(scene, region_ids)
    regions, hole = selection.regions, selection.pixels
    steps = check_offset(offset)
    background_labels = nearest_labels(regions.labels, hole)
    landing, labels = shift_labels(regions.labels, hole, steps, background_labels)

    lost_ids = regions.ids[~torch.isin(regions.ids, labels)].tolist()
    if lost_ids:
        warn_user(f"regions {', '.join(map(str, lost_ids))} are lost: covered, or out of the image")

    field = scene.field
    if fill and (hole & ~landing).any():
        background = Scene(field.subset(~selection.members), regions.relabel(background_labels))
        uncovered = dilate(~landing, _contour_reach(regions))
        filled = fill_hole(background, hole, hole & uncovered)
        field = join(filled.field, field.subset(selection.members))
    field = field.subset(members_of(field, labels))
    with torch.no_grad():
        shift = field.means.new_tensor(steps)
        field.means += torch.where(members_of(field, selection.ids)[:, None], shift, 0.0)
    return Scene(field, regions.relabel(labels, "mean"), scene.metadata)


def _contour_reach(regions: RegionMap) -> int:
    """Return the distance from a contour, in pixels, within which one sees what is behind a region."""
    softness = regions.softness
    assert not isinstance(softness, tuple)  # of one map
    largest = softness if isinstance(softness, float) else max(softness.values(), default=0.0)
    return math.ceil(1.0 + _CONTOUR_SIGMAS * largest)


def recolor_region(
    scene: Scene,
    region_ids: int | Iterable[int],
    gain: Numbers | None = None,
    bias: Numbers | None = None,
    *,
    color: str | Numbers | None = None,
) -> Scene:
    r"""Change the colours of regions in the image to c' = gain c + bias, or give them another colour.

    Convention: a gain acts on the colours of the Gaussians. A bias is one more Gaussian per region, flat over the whole
    image, for pixels are sums of Gaussians, not means. A `color` is that of the brightest tenth of a region, and keeps
    its shading: it is multiplied by the luma of each pixel over the luma there. Where brighter pixels would pass 1, the
    region is darker, the brightest tenth by a quarter at most: then the contrast is less. Regions whose brightest tenth
    is below a quarter get the contrast of one where it is a quarter.

    Args:
        scene: with region ids; of a batch, all images. With `color` it needs a map.
        region_ids: an id of some of its Gaussians, or several.
        gain: a number, one for each channel :math:`(C)`, or a matrix :math:`(C, C)`: tensors, arrays or lists.
        bias: a number, or one for each channel :math:`(C)`; None: no Gaussian is added.
        color: in place of gain and bias, a name such as "red" or "#ff0000", or a number for each channel :math:`(C)`.

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
        >>> recolor_region(scene, 0, color="red").render().shape
        torch.Size([3, 4, 6])
    """
    field = check_type(scene).field
    if field.region_ids is None:
        raise ValueError("scene must have region ids; call scene.field.assign_regions(regions)")
    ids = unique_region_ids(region_ids, field.region_ids, "Gaussians")
    if (color is None) == (gain is None and bias is None):
        raise ValueError("color must be given, or gain or bias; got both or neither")
    if color is None:
        return _recolor(scene, ids, 1.0 if gain is None else gain, bias)
    for region_id in ids:
        scene = _paint(scene, region_id, color)
    return scene


def _recolor(scene: Scene, ids: list[int], gain: Numbers, bias: Numbers | None) -> Scene:
    field = scene.field
    members = members_of(field, torch.tensor(ids, device=field.means.device))
    channels = field.colors.shape[-1]
    matrix = _color_tensor("gain", gain, field.colors, [(), (channels,), (channels, channels)])
    result = field.subset(torch.ones_like(members)) if field.means.ndim == 2 else field[:]
    with torch.no_grad():
        colors = result.colors[members]
        result.colors[members] = colors @ matrix.T if matrix.ndim == 2 else colors * matrix
    if bias is not None:
        color = _color_tensor("bias", bias, field.colors, [(), (channels,)]).expand(channels)
        for region_id in ids:
            result = join(result, _flat_gaussian(result, region_id, color))
    return Scene(result, scene.regions, scene.metadata)


def _paint(scene: Scene, region_id: int, color: str | Numbers) -> Scene:
    """Give a region a colour: the colour times a linear function of the luma, 1 at that of the brightest tenth."""
    if scene.regions is None:
        raise InvalidArgument("scene", "a label map", "none", verb="have")
    pixels = scene.regions.labels == region_id
    if not pixels.any():
        raise InvalidArgument("region_ids", "of regions with pixels in the map", region_id)
    with torch.no_grad():
        image = scene()
    channels = image.shape[-3]
    target = _color_tensor("color", _named_color(color), image, [(channels,)])
    weights = image.new_tensor(LUMA) if channels == len(LUMA) else image.new_full((channels,), 1 / channels)
    luma = torch.einsum("...chw,c->...hw", image, weights)
    inside = luma[pixels.expand(luma.shape)]
    reference, brightest = (
        inside.kthvalue(math.ceil(share * len(inside))).values for share in (_BRIGHT_SHARE, _UNCLIPPED_SHARE)
    )
    contrast = 1.0 / reference.clamp_min(_MIN_LUMA)
    top, limit = 1.0 + contrast * (brightest - reference), 1.0 / target.max()
    if 1.0 <= limit < top:
        contrast = torch.minimum(contrast * limit / top, (limit - _LEAST_COLOR) / (brightest - reference))
        top = limit
    bias = target * (top - contrast * brightest)
    return _recolor(scene, [region_id], contrast * torch.outer(target, weights), bias if bias.any() else None)


def _named_color(color: str | Numbers) -> Numbers:
    """Return the numbers of a colour's name, in RGB."""
    if not isinstance(color, str):
        return color
    from PIL import ImageColor

    try:
        return [level / 255 for level in ImageColor.getrgb(color)[:3]]
    except ValueError:
        raise InvalidArgument("color", "a name such as red or #ff0000", repr(color)) from None


def _color_tensor(name: str, value: Numbers, colors: Tensor, shapes: list[tuple[int, ...]]) -> Tensor:
    """Return numbers of one of the shapes in the dtype and on the device of the colours."""
    if isinstance(value, Sequence | np.ndarray) and not isinstance(value, str):
        try:
            value = torch.as_tensor(value, dtype=colors.dtype)
        except (TypeError, ValueError) as error:
            raise TypeError(f"{name} must hold numbers; got {value!r}") from error
    number = value if isinstance(value, Tensor) else colors.new_tensor(check_number(name, value))
    tensor = check_floating(name, number).detach().to(colors)
    if tuple(tensor.shape) not in shapes:
        raise ValueError(f"{name} must have shape {' or '.join(map(str, shapes))}; got {tuple(tensor.shape)}")
    return tensor


def _flat_gaussian(field: GaussianField, region_id: int, color: Tensor) -> GaussianField:
    """Return one Gaussian of a colour that is the same all over the image, or all images of a batch."""
    height, width = field.size
    sigma = _FLAT_SIGMA * max(height, width)
    lead = (*field.means.shape[:-2], 1)
    mean, factor = field.means.new_tensor([width / 2, height / 2]), field.means.new_tensor([sigma, 0.0, sigma])
    means, cholesky, colors = (t.expand(*lead, -1) for t in (mean, factor, color))
    ids = torch.full(lead, region_id, device=field.means.device)
    return GaussianField(means, cholesky, colors, ids, size=field.size)


def delete_region(scene: Scene, region_ids: int | Iterable[int], *, fill: bool = True) -> Scene:
    """Delete regions with their Gaussians; their neighbours take over their pixels.

    Convention: each pixel takes the label of the nearest pixel of another region, and is filled. Arguments and errors
    are those of :func:`move_region`. Where the softness differs by pairs of regions, contours between regions that did
    not touch before are hard. :func:`kcgs.video.delete_from_video` deletes them from all frames of a video, and always
    fills what they hid, from frames that show it.

    Example:
        >>> labels = torch.tensor([[0, 0, 3, 3, 3, 5]])
        >>> scene = Scene(GaussianField.random(9, (1, 6), regions=labels, seed=0), labels)
        >>> delete_region(scene, 3).regions.labels
        tensor([[0, 0, 0, 0, 5, 5]])
    """
    regions, _, hole, members = select_removable_regions(scene, region_ids)
    labels = nearest_labels(regions.labels, hole)
    edited = Scene(scene.field.subset(~members), regions.relabel(labels), scene.metadata)
    return fill_hole(edited, hole, hole) if fill else edited


def extract_region(scene: Scene, region_ids: int | Iterable[int]) -> Scene:
    """Keep the Gaussians of some regions: the scene shows them where they were, and black elsewhere.

    The map stays whole, so that contours stay as they were: `num_regions` counts the other regions too, and the repr of
    the scene says how many regions have no Gaussian. Arguments are those of :func:`move_region`; the map may be
    resized. :func:`render_region` renders regions with their membership as alpha.

    Example:
        >>> labels = torch.tensor([[0, 0, 3, 3, 3, 5]])
        >>> scene = Scene(GaussianField.random(9, (1, 6), regions=labels, seed=0), labels)
        >>> extract_region(scene, 3).field.region_ids.unique()
        tensor([3])
    """
    selection = select_regions(scene, region_ids)
    return Scene(scene.field.subset(selection.members), selection.regions, scene.metadata)


def replace_background(scene: Scene, region_ids: int | Iterable[int], background: Scene) -> Scene:
    """Put another scene in place of some regions, stretched to the size of this one.

    Convention: the regions of the background, or the background as one region, get ids above those of the scene. Where
    the softness of the scene differs by pairs of regions, a new contour has their mean.

    Args:
        scene: unbatched, with a map of its own size, not a resized one.
        region_ids: the regions that the background replaces: an id in the map, or several.
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
    regions, _, pixels, members = select_regions(scene, region_ids)
    other, field = check_scene(background, "background").field, scene.field
    channels = field.colors.shape[-1]
    if other.colors.shape[-1] != channels:
        raise ValueError(f"background must have {channels} channels; got {other.colors.shape[-1]}")
    first_id = int(regions.ids.max()) + 1
    background_labels = torch.full_like(regions.labels, first_id)
    ids = background_labels.new_full((other.num_gaussians,), first_id)
    if background.regions is not None and other.region_ids is not None:
        background_map = RegionMap.from_labels(background.regions.labels).resize(scene.size)
        background_labels = background_map.labels.to(ids.device) + first_id
        ids = other.region_ids.to(ids.device) + first_id
    labels = torch.where(pixels, background_labels, regions.labels)
    means, cholesky, colors = (t.to(field.means) for t in (*scaled_gaussians(other, scene.size), other.merged_colors()))
    new_field = join(field.subset(~members), GaussianField(means, cholesky, colors, ids, size=scene.size))
    new_field = new_field.subset(members_of(new_field, labels))
    return Scene(new_field, regions.relabel(labels, "mean"), scene.metadata)
