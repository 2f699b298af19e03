"""Fits of a video: frames in, a batch of scenes out, in which a row is the same Gaussian from frame to frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sized
from itertools import chain, repeat
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from kcgs._check import check_count
from kcgs._progress import Progress
from kcgs.errors import InvalidArgument
from kcgs.fitting import FitConfig, fit
from kcgs.fitting.problem import check_image_and_regions
from kcgs.functional import RegionMap, lookup_regions
from kcgs.kernels import threads_for_kernels
from kcgs.nn import GaussianField
from kcgs.scene import Scene

from .descent import Descent, region_positions, squared_error, sum_over_pixels
from .gaussians import Gaussians
from .motion import estimate_motion, move_labels, move_points

OnFrame = Callable[[int, Scene], bool | None]
Labels = RegionMap | Tensor | NDArray[Any]

# frames per second where nothing says so
_FRAME_RATE = 24.0
# a start whose squared error is more than this share of the frame's variance is a scene cut
_CUT = 0.5
# iterations before which the least useful rows are relocated, and the share that is
_RELOCATIONS = dict.fromkeys((0, 20, 40, 60), 0.05)
# pixels change where the error about them, in a square of so many pixels, is this many times that of their fit, and a
# level of 255 more
_STILL = 1.02
_SURROUNDINGS = 15
_LEVEL = 255.0**-2
# share of a Gaussian on pixels that changed from which on it may move
_FREE_SHARE = 0.1


@torch.inference_mode(False)
@torch.no_grad()
def fit_video(
    frames: Iterable[Any],
    label_maps: Labels | Iterable[Labels] | None = None,
    num_gaussians: int = 1000,
    *,
    recipe: str | FitConfig = "best",
    seed: int = 0,
    on_frame: OnFrame | None = None,
    progress: bool = False,
    **settings: Any,
) -> Scene:
    r"""Fit Gaussians to the frames of a video: time is the batch.

    Convention: row i is the same Gaussian in every frame until it is relocated. The first frame is fitted by
    :func:`kcgs.fit`. Every other starts from the Gaussians of the one before, which move with the image; then contours
    move, the least useful 5 % are relocated four times, and all descend a little. What is explained as well as
    before stands still. A row without use has colour 0. A scene cut is fitted anew, into the same rows. Regions are not
    merged. Contours have the widths of the first frame.
    The same arguments, device and number of threads give the same scenes, bit for bit.

    Args:
        frames: T images of one size, as :func:`kcgs.fit` takes them; two are held at a time. :func:`read_video` gives
            them, and their rate.
        label_maps: one for each frame; or the first frame's alone, :math:`(H, W)`, which moves with the image, up to a
            scene cut: after it there is one region. None: one region.
        num_gaussians: N, of every frame.
        recipe: of the first frame, and of what follows a scene cut.
        seed: of the random start.
        on_frame: called with the number of every frame, from 0, and its scene; returning True stops.
        progress: show how many frames are done.
        settings: fields of :class:`kcgs.FitConfig`, in place of the recipe's.

    Returns:
        Scenes: a field of T x N Gaussians, T label maps if there are any, and ``metadata["frame_rate"]``, in frames
        per second: that of `frames`, or 24.

    Raises:
        TypeError: wrong types.
        ValueError: as :func:`kcgs.fit`; no frames; a frame of another size, or without a label map.

    Example:
        >>> frames = [torch.zeros(3, 16, 24) for _ in range(3)]
        >>> for t, frame in enumerate(frames):
        ...     frame[:, 4:12, 4 + t : 12 + t] = 1.0
        >>> scenes = fit_video(frames, num_gaussians=8, iterations=100)
        >>> len(scenes), scenes.num_gaussians, scenes.render().shape
        (3, 8, torch.Size([3, 3, 16, 24]))
    """
    config = FitConfig.from_recipe(recipe, **({"merge_regions": False} | settings))
    video = _Video(config, check_count("num_gaussians", num_gaussians), seed)
    length = len(frames) if isinstance(frames, Sized) else None
    with Progress("fit-video", known=length is not None, shown=progress) as bar:
        for number, (frame, labels) in enumerate(_pairs(frames, label_maps if config.guidance else None)):
            scene = video.add(frame, labels)
            bar.update((number + 1) / (length or math.inf), f"frame {number + 1}")
            if on_frame is not None and on_frame(number, scene):
                break
    if not video.frames:
        raise InvalidArgument("frames", "at least one frame", "none", verb="hold")
    rate = float(getattr(frames, "frame_rate", _FRAME_RATE))
    return stack(video.frames, scene.size, {"frame_rate": f"{rate:.10g}"})


class _Video:
    """The frames that are done, and what the next one starts from."""

    def __init__(self, config: FitConfig, num_gaussians: int, seed: int) -> None:
        self.config, self.num_gaussians, self.seed = config, num_gaussians, seed
        self.frames: list[Gaussians] = []
        self.image = torch.zeros(())
        self.error = torch.zeros(())  # of each pixel, (H, W), when it was last fitted

    def add(self, frame: Any, labels: Labels | None) -> Scene:
        """Fit a frame; labels None: the map before is carried on, where there is one."""
        before = self.image
        self.image, regions = check_image_and_regions(frame, labels)
        changed = torch.ones_like(self.image[0], dtype=torch.bool)
        if not self.frames:
            gaussians = self._fit_anew(regions)
        elif before.shape != self.image.shape:
            name = f"frame {len(self.frames)}"
            raise InvalidArgument(name, f"shape {tuple(before.shape)}", tuple(self.image.shape), verb="have")
        else:
            with threads_for_kernels(before[0].numel()):
                gaussians, changed = self._follow(before, regions)
        self.frames.append(gaussians)
        self.error = torch.where(changed, squared_error(gaussians, self.image, self.config), self.error)
        return gaussians.scene((self.image.shape[1], self.image.shape[2]))

    def _fit_anew(self, regions: RegionMap | None) -> Gaussians:
        """Fit a frame by itself; rows that it leaves unused have colour 0."""
        config = self.config
        if self.frames:  # contours have the widths of the first frame
            config = config.model_copy(update={"softness": 0.0})
        scene = fit(self.image, regions, self.num_gaussians, recipe=config, seed=self.seed).scene
        field, missing = scene.field, self.num_gaussians - scene.num_gaussians
        means, cholesky = (pad(t.detach(), (0, 0, 0, missing), value=1.0) for t in (field.means, field.cholesky))
        colors = pad(field.merged_colors().detach(), (0, 0, 0, missing))
        regions = scene.regions or regions  # a fit leaves out a map of one region
        if regions is None:
            return Gaussians(means, cholesky, colors, None, None)
        ids = regions.ids[:1].expand(self.num_gaussians).clone()
        if field.region_ids is not None:
            ids[: len(field.region_ids)] = field.region_ids
        return Gaussians(means, cholesky, colors, ids, regions)

    def _follow(self, previous: Tensor, regions: RegionMap | None) -> tuple[Gaussians, Tensor]:
        """Return a frame, fitted from the one before, and which pixels changed."""
        image, first, before = self.image, self.frames[0].regions, self.frames[-1].regions
        motion, is_carried = estimate_motion(previous, image), regions is None
        if first is not None and before is not None:
            labels = move_labels(motion, before.labels) if regions is None else regions.labels
            regions = first.relabel(labels, "mean")
        start, free, changed = self._choose_start(motion, regions)
        descent = Descent(image, start, self.config, free, changed)
        if descent.error() > _CUT * float(image.var((1, 2)).mean()):
            if is_carried and regions is not None:
                regions = regions.relabel(regions.labels.flatten().mode()[0].expand(regions.size))
            return self._fit_anew(regions), torch.ones_like(changed)
        if changed.any():
            start = descent.run(_RELOCATIONS, None if regions is None else regions.labels)
        return start, changed

    def _choose_start(self, motion: Tensor, regions: RegionMap | None) -> tuple[Gaussians, Tensor, Tensor]:
        """Return the Gaussians before, moved, which of them may move, and which pixels changed.

        A pixel changed if the Gaussians, without motion, explain its surroundings less well than when they were fitted.
        """
        means, cholesky, colors, ids, _ = self.frames[-1]
        if regions is not None and ids is not None:  # rows of a region that is no longer there have no use
            present = torch.isin(ids, regions.ids)
            ids, colors = torch.where(present, ids, regions.ids[0]), torch.where(present[:, None], colors, 0.0)
        unmoved = Gaussians(means, cholesky, colors, ids, regions)
        error = squared_error(unmoved, self.image, self.config)
        changed = _blur(error) > _STILL * _blur(self.error) + _LEVEL
        _, sums = sum_over_pixels(unmoved, self.image, self.config)
        free = sums(changed[None].to(motion)) >= _FREE_SHARE * sums(torch.ones_like(motion[:1]))
        means = torch.where(free[:, None], _move_by_region(motion, unmoved), means)
        return unmoved._replace(means=means), free, changed


def stack(frames: list[Gaussians], size: tuple[int, int], metadata: Mapping[str, str]) -> Scene:
    """Put the Gaussians and the maps of all frames into one scene."""
    means, cholesky, colors = (torch.stack(parts) for parts in zip(*(frame[:3] for frame in frames), strict=True))
    maps = [frame.regions for frame in frames if frame.regions is not None]
    if not maps:
        return Scene(GaussianField(means, cholesky, colors, size=size), None, metadata)
    ids = torch.stack([frame.region_ids for frame in frames if frame.region_ids is not None])
    # the same pair has the same width in all frames
    widths: dict[tuple[int, int], float] = {}
    for regions in maps:
        widths |= regions.softness if isinstance(regions.softness, Mapping) else {}
    labels = torch.stack([regions.labels for regions in maps])
    stacked = RegionMap.from_labels(labels, widths or maps[0].softness)
    return Scene(GaussianField(means, cholesky, colors, ids, size=size), stacked, metadata)


def _blur(error: Tensor) -> Tensor:
    return avg_pool2d(error[None], _SURROUNDINGS, 1, _SURROUNDINGS // 2, count_include_pad=False)[0]


def _move_by_region(motion: Tensor, gaussians: Gaussians) -> Tensor:
    """Move centres along a motion; those that would leave their region go as the region does on the mean."""
    means, _, _, ids, regions = gaussians
    moved = move_points(motion, means)
    if regions is None or ids is None:
        return moved
    rows, pixels = region_positions(gaussians, motion)
    sums = [pixels.flatten().bincount(part.flatten()) for part in motion]
    mean = torch.stack(sums, -1) / pixels.flatten().bincount()[:, None]
    inside = lookup_regions(moved, regions.labels) == ids
    return torch.where(inside[:, None], moved, means - mean[rows].to(means))


def _pairs(frames: Iterable[Any], label_maps: Labels | Iterable[Labels] | None) -> Iterator[tuple[Any, Labels | None]]:
    """Yield each frame with its label map; a map of the first alone, and None, are followed by None."""
    maps: Iterator[Labels | None]
    if label_maps is None:
        maps = repeat(None)
    elif isinstance(label_maps, RegionMap) or (isinstance(label_maps, Tensor | np.ndarray) and label_maps.ndim == 2):
        maps = chain([label_maps], repeat(None))
    else:
        maps = iter(label_maps)
    for number, frame in enumerate(frames):
        try:
            yield frame, next(maps)
        except StopIteration:
            raise ValueError(f"label_maps must have a map for each frame, or be one map; got {number}") from None
