"""Images of some regions alone, and of a scene over another image."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from kcgs._check import check_image, check_size
from kcgs.functional import region_splat
from kcgs.nn import GaussianField, RegionSplatRenderer
from kcgs.nn.field import scaled
from kcgs.nn.renderer import area_mean, rendered_size
from kcgs.scene import Scene

from .checks import check_field, check_scene, ids_of


def render_region(
    scene: Scene, region_ids: int | Iterable[int], size: tuple[int, int] | None = None, *, clamp: bool = True
) -> Tensor:
    r"""Render regions alone, with their share of each pixel as alpha.

    Convention: colours are straight, not multiplied by alpha: what the regions paint where they have the pixel to
    themselves, also under a soft contour. They are 0 where alpha is. Shares of all regions add up to one; without
    `clamp` the sum of alpha times colour over all of them is the image. Differentiable, as the renderer is.

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
    target = check_field(scene).size if size is None else check_size("size", size)
    regions, chosen = check_scene(scene, region_ids)
    finer = rendered_size(scene.size, target)
    regions = regions.resize(finer)
    weights = {region: regions.weights(region) for region in chosen.tolist()}
    total = torch.stack([*weights.values()]).sum(0)
    alpha = total.clamp_max(1.0).to(scene.field.colors.dtype)
    colors = scene.field.colors.new_zeros(scene.field.colors.shape[-1], *finer)
    for region, weight in weights.items():
        # rendered alone and not confined, which is the colour itself: nothing is divided by a small alpha
        members = _part(scene.field, ids_of(scene.field) == region)
        members.region_ids = None
        alone = region_splat(*scaled(members, finer), members.merged_colors(), size=finer)
        share = (weight / torch.where(total > 0, total, 1.0)).to(alone.dtype)
        colors = colors + torch.where(alpha > 0, alone * share, 0.0)
    if finer != target:
        colors, alpha = area_mean(colors * alpha, target), area_mean(alpha, target)
        colors = torch.where(alpha > 0, colors / torch.where(alpha > 0, alpha, 1.0), 0.0)
    return torch.cat([colors.clamp(0.0, 1.0) if clamp else colors, alpha[None]])


def render_over(scene: Scene, region_ids: int | Iterable[int], image: Tensor) -> Tensor:
    r"""Render the scene with an image in place of some regions, at the size of that image.

    Convention: the image gets the share of each pixel that those regions had, so that soft contours blend with it as
    they did with them. Not clipped. Differentiable in the scene and in the image.

    Args:
        scene: unbatched, with a map.
        region_ids: the regions that make the background now: an id in the map, or several.
        image: :math:`(C, H, W)`, as many channels as the scene has; any size.

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
    channels = check_field(scene).colors.shape[-1]
    if image.ndim != 3 or image.shape[0] != channels:
        raise ValueError(f"image must have shape ({channels}, H, W); got {tuple(image.shape)}")
    target = (image.shape[-2], image.shape[-1])
    regions, gone = check_scene(scene, region_ids)
    stays = _part(scene.field, ~torch.isin(ids_of(scene.field), gone))
    rendered: Tensor = RegionSplatRenderer()(stays, regions, target)
    finer = rendered_size(scene.size, target)
    share = regions.resize(finer).weights(gone.tolist()).clamp_max(1.0).to(rendered.dtype)
    share = area_mean(share, target)
    return rendered + share * image.to(rendered)


def _part(field: GaussianField, mask: Tensor) -> GaussianField:
    """Take the Gaussians that `mask` selects, in the graph."""
    opacities = None if field.opacities is None else field.opacities[mask]
    means, cholesky, colors = (t[mask] for t in (field.means, field.cholesky, field.colors))
    return GaussianField(means, cholesky, colors, ids_of(field)[mask], opacities, size=field.size)
