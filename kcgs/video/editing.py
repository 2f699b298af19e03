"""Edits of all frames of a video: pixels that a region hides are filled from frames that show them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from kcgs.compiled import threads_for_kernels
from kcgs.editing import check_offset, shift_labels, unique_region_ids, warn_of_lost_regions
from kcgs.fitting import FitConfig, config_for
from kcgs.maps import RegionMap
from kcgs.nn import GaussianField, clear_lost_rows, join, used_rows
from kcgs.optim import Gaussians
from kcgs.scene import Scene, check_batch

from .background import affine_motions, apply_affine, restore_background
from .frame_descent import FrameDescent
from .stacking import stack


@torch.inference_mode(False)
@torch.no_grad()
def delete_from_video(scenes: Scene, region_ids: int | Iterable[int]) -> Scene:
    """Delete regions from all frames, and show the background; :func:`kcgs.editing.delete_region` edits one image.

    Convention: a hidden pixel takes colour and label from the nearest frame that shows it. Its place there is computed
    from the motion of the other regions' Gaussians; this motion is assumed to be affine. Pixels that no frame shows
    continue their surroundings. The rows of the deleted regions are fitted to the filled pixels. In the new scenes no
    Gaussian is thinner than the default `min_sigma` of a fit, 0.5 pixels.

    Args:
        scenes: T frames with label maps, as :func:`fit_video` returns them.
        region_ids: an id of the maps, or several.

    Returns:
        New scenes with as many rows, without a graph.

    Raises:
        TypeError: no batch of scenes.
        ValueError: no label maps, an unknown id, or a frame without other regions.

    Example:
        >>> labels = torch.zeros(3, 16, 24, dtype=torch.long)
        >>> for t in range(3):
        ...     labels[t, 4:12, 4 * t : 4 * t + 8] = 7
        >>> field = GaussianField(24 * torch.rand(3, 20, 2), torch.tensor([3.0, 0.0, 3.0]).expand(3, 20, 3),
        ...                       torch.rand(3, 20, 3), size=(16, 24)).assign_regions(labels)
        >>> delete_from_video(Scene(field, labels), 7).regions.ids
        tensor([0])
    """
    regions, row_ids, deleted_ids = _check(scenes, region_ids)
    deleted_pixels, deleted_rows = torch.isin(regions.labels, deleted_ids), torch.isin(row_ids, deleted_ids)
    # scenes do not store the settings of their fit: the defaults hold
    config, frames = config_for("video", FitConfig()), list[Scene]()
    with threads_for_kernels(scenes.size[0] * scenes.size[1]):
        motions = affine_motions(scenes.field.means.detach(), ~deleted_rows)
        images, labels = restore_background(scenes.render(), regions.labels, deleted_pixels, motions)
        new_regions = regions.relabel(labels, "mean")
        for t, scene in enumerate(scenes):
            means, cholesky, colors = (table.clone() for table in Gaussians.of(scene.field)[:3])
            ids = torch.where(deleted_rows[t], new_regions[t].ids[0], row_ids[t])
            colors[deleted_rows[t]] = 0.0
            if t:  # rows that filled the frame before continue
                rows, before = deleted_rows[t] & deleted_rows[t - 1], Gaussians.of(frames[-1].field)
                means[rows] = apply_affine(motions[t] @ motions[t - 1].inverse(), before.means[rows])
                cholesky[rows], colors[rows] = before.cholesky[rows], before.colors[rows]
                if before.region_ids is not None:
                    ids[rows] = before.region_ids[rows]
            field = GaussianField(means, cholesky, colors, ids, size=scenes.size)
            start = Scene(field, new_regions[t])
            movable_rows, changed_pixels = torch.ones_like(deleted_rows[t]), torch.ones_like(deleted_pixels[t])
            unused = deleted_rows[t] & ~used_rows(colors)
            descent = FrameDescent(images[t], start, config, movable_rows, changed_pixels)
            frames.append(descent.run({0: float(unused.float().mean())}))
    return stack(frames, scenes.metadata)


@torch.inference_mode(False)
@torch.no_grad()
def move_in_video(scenes: Scene, region_ids: int | Iterable[int], offset: Sequence[float]) -> Scene:
    """Move regions in all frames, over the regions at the new place; :func:`kcgs.editing.move_region` edits one image.

    Convention: the pixels that they leave are filled as by :func:`delete_from_video`.

    Args:
        scenes: T frames with label maps, as :func:`fit_video` returns them.
        region_ids: an id of the maps, or several, which move together.
        offset: (dx, dy) in whole pixels.

    Returns:
        New scenes, without a graph. The rows of the regions come last.

    Raises:
        TypeError, ValueError: as :func:`delete_from_video`; an offset that is not two whole numbers.

    Warns:
        UserWarning: regions are lost in all frames; it names their ids.
    """
    regions, row_ids, ids = _check(scenes, region_ids)
    steps = check_offset(offset)
    background = delete_from_video(scenes, region_ids)
    assert background.regions is not None
    is_member, field = torch.isin(row_ids, ids), scenes.field
    rows = is_member.any(0)
    means = field.means[:, rows] + field.means.new_tensor(steps)
    colors = (field.merged_colors() * is_member[..., None])[:, rows]
    region_field = GaussianField(means, field.cholesky[:, rows], colors, row_ids[:, rows], size=scenes.size)
    labels = shift_labels(regions.labels, torch.isin(regions.labels, ids), steps, background.regions.labels)[1]
    warn_of_lost_regions(regions, labels)
    new_regions = regions.relabel(labels, "mean")
    return Scene(clear_lost_rows(join(background.field, region_field), new_regions), new_regions, scenes.metadata)


def _check(scenes: Scene, region_ids: int | Iterable[int]) -> tuple[RegionMap, Tensor, Tensor]:
    """Validate the arguments; return the maps, the region ids of the rows (T, N), and the ids of the argument."""
    count, regions, row_ids = len(check_batch(scenes)), scenes.regions, scenes.field.region_ids
    if regions is None or row_ids is None or regions.num_maps != count:
        raise ValueError("scenes must have a label map for each frame, and region ids")
    ids = torch.tensor(unique_region_ids(region_ids, regions.ids, "maps"), device=regions.ids.device)
    has_others = (~torch.isin(regions.labels, ids)).flatten(1).any(1)
    if not has_others.all():
        frame = int(has_others.min(0)[1])
        raise ValueError(f"region_ids must leave a region in every frame; got all regions of frame {frame}")
    return regions, row_ids, ids
