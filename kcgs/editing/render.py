"""Render some regions alone, or a scene over another image."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from kcgs._check import check_image, check_size
from kcgs.errors import InvalidArgument
from kcgs.functional import region_splat
from kcgs.nn import GaussianField, RegionSplatRenderer, area_mean, rendered_size, scaled_gaussians
from kcgs.scene import Scene

from .selection import select_regions


def render_region(
    scene: Scene, region_ids: int | Iterable[int], size: tuple[int, int] | None = None, *, clamp: bool = True
) -> Tensor:
    r"""Render regions alone, with their membership of each pixel as alpha.

    Convention: colours are not multiplied by alpha: also under a soft contour they are the colours that the regions
    would have there without other regions. They are 0 where alpha is 0. Without `clamp`, the sum of alpha times colour
    over all regions is the image. Differentiable, like the renderer.

    Args:
        scene: unbatched, with a map.
        region_ids: an id in the map, or several.
        size: (height, width) of the result; None: the scene's.
        clamp: clip colours to [0, 1], as image files hold them.

    Returns:
        RGBA, :math:`(4, H, W)`; :math:`(C + 1, H, W)` for C channels.

    Raises:
        TypeError, ValueError: wrong types; a batch, no map, an unknown id.

    Example:
        >>> labels = torch.tensor([[0, 0, 3, 3, 3, 5]])
        >>> scene = Scene(GaussianField.random(9, (1, 6), regions=labels, seed=0), labels)
        >>> render_region(scene, 3)[3].tolist()
        [[0.0, 0.0, 1.0, 1.0, 1.0, 0.0]]
    """
    selection, field = select_regions(scene, region_ids), scene.field
    target = scene.size if size is None else check_size("size", size)
    render_size = rendered_size(scene.size, target)
    regions = selection.regions.resize(render_size)
    memberships = {region: regions.membership(region) for region in selection.ids.tolist()}
    total = torch.stack([*memberships.values()]).sum(0)
    alpha = total.clamp_max(1.0).to(field.colors.dtype)
    colors = field.colors.new_zeros(field.colors.shape[-1], *render_size)
    gaussians = *scaled_gaussians(field, render_size), field.merged_colors()
    for region, membership in memberships.items():
        # a render without the map gives the colour itself: no division by a small alpha
        rows = field.region_ids == region
        region_image = region_splat(*(t[rows] for t in gaussians), size=render_size)
        share = (membership / torch.where(total > 0, total, 1.0)).to(region_image.dtype)
        colors = colors + torch.where(alpha > 0, region_image * share, 0.0)
    if render_size != target:
        colors, alpha = area_mean(colors * alpha, target), area_mean(alpha, target)
        colors = torch.where(alpha > 0, colors / torch.where(alpha > 0, alpha, 1.0), 0.0)
    return torch.cat([colors.clamp(0.0, 1.0) if clamp else colors, alpha[None]])


def render_over(scene: Scene, region_ids: int | Iterable[int], image: Tensor) -> Tensor:
    r"""Render the scene with an image in place of some regions, at the size of this image.

    Convention: the image gets the membership of the replaced regions, so that soft contours blend with it as they did
    with the regions. The result is not clipped. It is differentiable in the scene and in the image.

    Args:
        scene: unbatched, with a map.
        region_ids: the regions that the image replaces: an id in the map, or several.
        image: :math:`(C, H, W)`, with the scene's number of channels and any size.

    Returns:
        Image, :math:`(C, H, W)`.

    Raises:
        TypeError, ValueError: as :func:`render_region`; another number of channels.

    Example:
        >>> labels = torch.tensor([[0, 0, 3, 3, 3, 5]])
        >>> scene = Scene(GaussianField.random(9, (1, 6), regions=labels, seed=0), labels)
        >>> render_over(scene, [0, 5], torch.full((3, 1, 6), 0.25))[0, 0, [0, 1, 5]].tolist()
        [0.25, 0.25, 0.25]
    """
    image = check_image("image", image)
    selection, field = select_regions(scene, region_ids), scene.field
    channels = field.colors.shape[-1]
    if image.ndim != 3 or image.shape[0] != channels:
        raise InvalidArgument("image", f"shape ({channels}, H, W)", tuple(image.shape), verb="have")
    target = (image.shape[-2], image.shape[-1])
    rows = ~selection.members
    tensors = field.means, field.cholesky, field.merged_colors(), field.region_ids
    others = GaussianField(*(t[rows] for t in tensors if t is not None), size=field.size)
    rendered: Tensor = RegionSplatRenderer()(others, selection.regions, target)
    regions = selection.regions.resize(rendered_size(scene.size, target))
    membership = regions.membership(selection.ids.tolist()).clamp_max(1.0).to(rendered.dtype)
    return rendered + area_mean(membership, target) * image.to(rendered)
