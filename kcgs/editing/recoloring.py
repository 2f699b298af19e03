"""Change the colours of regions: each edit returns a new scene."""

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
from kcgs.errors import InvalidArgument, InvalidArgumentType
from kcgs.nn import GaussianField, join
from kcgs.scene import Scene, check_type

from .selection import members_of, unique_region_ids

Numbers = Tensor | NDArray[Any] | Sequence[Any] | float

# standard deviation of a flat Gaussian, in longer sides of the image: its values differ by at most 3 in 10^7
_FLAT_SIGMA = 1e3
# default share of a new colour in a recoloured region: pale objects keep some of their old colour
_STRENGTH = 0.75
# quantile of a region's luma that gets exactly the new colour
_BRIGHT_SHARE = 0.9
# quantile of a region's luma that stays within [0, 1]: brighter glints may clip
_UNCLIPPED_SHARE = 0.995
# least factor of the new colour at the quantile `_BRIGHT_SHARE`, if the region must get darker to stay within [0, 1]
_LEAST_COLOR = 0.75
# least luma at this quantile in the computation of contrast: in darker regions noise would be visible
_MIN_LUMA = 0.25


def recolor_region(
    scene: Scene,
    region_ids: int | Iterable[int],
    gain: Numbers | None = None,
    bias: Numbers | None = None,
    *,
    color: str | Numbers | None = None,
    strength: float | None = None,
) -> Scene:
    r"""Change the colours of regions in the image to c' = gain c + bias, or give them another colour.

    Convention: a gain acts on the colours of the Gaussians. A bias adds one Gaussian per region, flat over the whole
    image, since pixels are sums of Gaussians, not means. A `color` keeps the region's shading: it is multiplied by the
    luma of each pixel, divided by the luma at which the brightest tenth of the region begins. If brighter pixels would
    pass 1, the region gets darker, there by at most a quarter; beyond that the contrast is reduced. If that luma is
    below 0.25, it counts as 0.25 for the contrast.

    Args:
        scene: with region ids; in a batch all images change. With `color` it needs a map.
        region_ids: an id of some of its Gaussians, or several ids.
        gain: a number, a number for each channel :math:`(C)`, or a matrix :math:`(C, C)`: tensors, arrays or lists.
        bias: a number, or a number for each channel :math:`(C)`; None: no Gaussian is added.
        color: in place of gain and bias, a name such as "red" or "#ff0000", or a number for each channel :math:`(C)`.
        strength: share of the new colour, in [0, 1]; the rest is the old colour; None: 0.75. With `color` only.

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
        raise InvalidArgument("color", "given, or gain or bias", "both or neither")
    if color is None:
        if strength is not None:
            raise InvalidArgument("strength", "None without color", strength)
        return _recolor(scene, ids, 1.0 if gain is None else gain, bias)
    strength = check_number("strength", _STRENGTH if strength is None else strength, 0, 1)
    for region_id in ids:
        scene = _paint(scene, region_id, color, strength)
    return scene


def _recolor(scene: Scene, ids: list[int], gain: Numbers, bias: Numbers | None) -> Scene:
    field = scene.field
    members = members_of(field, torch.tensor(ids, device=field.means.device))
    channels = field.colors.shape[-1]
    matrix = _color_tensor("gain", gain, field.colors, [(), (channels,), (channels, channels)])
    result = field.subset(torch.ones_like(members)) if field.num_images is None else field[:]
    with torch.no_grad():
        colors = result.colors[members]
        result.colors[members] = colors @ matrix.T if matrix.ndim == 2 else colors * matrix
    if bias is not None:
        color = _color_tensor("bias", bias, field.colors, [(), (channels,)]).expand(channels)
        for region_id in ids:
            result = join(result, _flat_gaussian(result, region_id, color))
    return Scene(result, scene.regions, scene.metadata)


def _paint(scene: Scene, region_id: int, color: str | Numbers, strength: float) -> Scene:
    """Replace a share of a region's colours, `strength`, by the new colour times a linear function of their luma.

    The function is top - contrast (brightest - luma), which is 1 at the luma `reference`. Where its largest value,
    `top`, would clip the colour, `top` and the contrast are lowered.
    """
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
    bias = strength * target * (top - contrast * brightest)
    gain = torch.eye(channels).to(image).lerp(contrast * torch.outer(target, weights), strength)
    return _recolor(scene, [region_id], gain, bias if bias.any() else None)


def _named_color(color: str | Numbers) -> Numbers:
    """Return the RGB values of a colour's name."""
    if not isinstance(color, str):
        return color
    from PIL import ImageColor

    try:
        return [level / 255 for level in ImageColor.getrgb(color)[:3]]
    except ValueError:
        raise InvalidArgument("color", "a name such as red or #ff0000", repr(color)) from None


def _color_tensor(name: str, value: Numbers, colors: Tensor, shapes: list[tuple[int, ...]]) -> Tensor:
    """Return numbers as a tensor of one of `shapes`, with the dtype and device of the colours."""
    if isinstance(value, Sequence | np.ndarray) and not isinstance(value, str):
        try:
            value = torch.as_tensor(value, dtype=colors.dtype)
        except (TypeError, ValueError) as error:
            raise InvalidArgumentType(name, "numbers", repr(value), verb="hold") from error
    number = value if isinstance(value, Tensor) else colors.new_tensor(check_number(name, value))
    tensor = check_floating(name, number).detach().to(colors)
    if tuple(tensor.shape) not in shapes:
        raise InvalidArgument(name, f"shape {' or '.join(map(str, shapes))}", tuple(tensor.shape), verb="have")
    return tensor


def _flat_gaussian(field: GaussianField, region_id: int, color: Tensor) -> GaussianField:
    """Return one Gaussian with the same colour over the whole image, or over all images of a batch."""
    height, width = field.size
    sigma = _FLAT_SIGMA * max(height, width)
    lead = (*field.means.shape[:-2], 1)
    mean, factor = field.means.new_tensor([width / 2, height / 2]), field.means.new_tensor([sigma, 0.0, sigma])
    means, cholesky, colors = (t.expand(*lead, -1) for t in (mean, factor, color))
    ids = torch.full(lead, region_id, device=field.means.device)
    return GaussianField(means, cholesky, colors, ids, size=field.size)
