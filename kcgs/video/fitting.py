"""Fit a video: the result is a batch of scenes in which a row is the same Gaussian from frame to frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sized
from itertools import chain, repeat
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d

from kcgs._progress import Progress
from kcgs.compiled import threads_for_kernels
from kcgs.errors import InvalidArgument
from kcgs.fitting import FitConfig, check_image_and_regions, check_num_gaussians, config_for, fit
from kcgs.maps import RegionMap, lookup_regions
from kcgs.nn import clear_lost_rows, pad_rows
from kcgs.optim import Gaussians
from kcgs.scene import Scene

from .files import DEFAULT_FRAME_RATE
from .flow import is_cut, move_labels, move_points, optical_flow
from .frame_descent import FrameDescent, renderer_of
from .stacking import stack

OnFrame = Callable[[int, Scene], bool | None]
Labels = RegionMap | Tensor | NDArray[Any]

# share of the movable rows that is relocated, by iteration of the descent
_RELOCATIONS = {0: 0.05, 20: 0.05, 40: 0.05, 60: 0.05}
# A pixel changed if the mean error around it is more than `_MAX_GROWTH` times the mean error after its fit, plus
# `_LEVEL`. Lower values follow faint changes, higher values flicker less.
_MAX_GROWTH = 1.02
# squared error of one level of 8 bits
_LEVEL = 255.0**-2
# side of the square of this mean, in pixels
_WINDOW = 15
# a Gaussian may move if at least this share of its weights is on changed pixels
_MOVABLE_SHARE = 0.1


@torch.inference_mode(False)
@torch.no_grad()
def fit_video(
    frames: Iterable[Any],
    label_maps: Labels | Iterable[Labels] | None = None,
    num_gaussians: int | None = None,
    *,
    recipe: str | FitConfig = "best",
    seed: int = 0,
    on_frame: OnFrame | None = None,
    progress: bool = False,
    **settings: Any,
) -> Scene:
    r"""Fit Gaussians to the frames of a video: the batch dimension is time.

    Convention: row i is the same Gaussian in every frame, until it is relocated. The first frame is fitted by
    :func:`kcgs.fit`. Every other frame starts from the Gaussians of the frame before, moved along the optical flow;
    Gaussians stay where the error has not grown. Then a short descent moves Gaussians and contours. It also relocates
    the 5 % of the movable rows with the lowest impact to where they lower the error most, four times. The first frame
    after a scene cut is fitted like the first frame, into the same rows. Rows that a frame does not use have the colour
    0. Regions are not merged, and contours keep the softness of the first frame. The same arguments, device and number
    of threads give the same scenes, bit for bit.

    Args:
        frames: T images of one size, as :func:`kcgs.fit` takes them, for example from :func:`read_video`; two are in
            memory at a time.
        label_maps: one map for each frame; or one map of the first frame, :math:`(H, W)`. This one moves with the
            image until a scene cut; after the cut there is one region. None: one region in all frames.
        num_gaussians: N of every frame; None: one per 100 pixels, at least 100.
        recipe: of the first frame, and of the first frame after a scene cut. The descent of the other frames takes
            from it the objective, cutoff, backend, `min_sigma` and the settings of contours.
        seed: of the random start.
        on_frame: called after each frame with its number, from 0, and its scene; returning True ends the fit.
        progress: show the number of fitted frames.
        settings: fields of :class:`kcgs.FitConfig`, in place of the recipe's.

    Returns:
        Scenes: a field of T x N Gaussians, T label maps if there are any, and ``metadata["frame_rate"]``, the frames
        per second of `frames`, or 24.

    Raises:
        TypeError: wrong types.
        ValueError: as :func:`kcgs.fit`; an objective that is neither l2 nor ms-ssim, such as a recipe's; `bounded`; no
            frames; a frame of another size; several label maps, but not one for each frame.

    Example:
        >>> frames = [torch.zeros(3, 16, 24) for _ in range(3)]
        >>> for t, frame in enumerate(frames):
        ...     frame[:, 4:12, 4 + t : 12 + t] = 1.0
        >>> scenes = fit_video(frames, num_gaussians=8, iterations=100)
        >>> len(scenes), scenes.num_gaussians, scenes.render().shape
        (3, 8, torch.Size([3, 3, 16, 24]))
    """
    config = config_for("video", FitConfig.from_recipe(recipe, **({"merge_regions": False} | settings)))
    video = _VideoFit(config, num_gaussians, seed)
    length = len(frames) if isinstance(frames, Sized) else None
    with Progress("fit-video", pulse=length is None, visible=progress) as bar:
        for number, (frame, labels) in enumerate(_pair(frames, label_maps if config.guidance else None)):
            scene = video.fit_next(frame, labels)
            bar.update((number + 1) / (length or math.inf), f"frame {number + 1}")
            if on_frame is not None and on_frame(number, scene):
                break
    if not video.frames:
        raise InvalidArgument("frames", "at least one frame", "none", verb="hold")
    frame_rate = float(getattr(frames, "frame_rate", DEFAULT_FRAME_RATE))
    return stack(video.frames, {"frame_rate": f"{frame_rate:.10g}"})


class _VideoFit:
    """A fit of one frame after another."""

    def __init__(self, config: FitConfig, num_gaussians: int | None, seed: int) -> None:
        self.config, self.num_gaussians, self.seed = config, num_gaussians, seed
        self.frames: list[Scene] = []
        self.image = torch.zeros(())  # the last frame, (C, H, W); a placeholder before the first
        self.error = torch.zeros(())  # squared error of each pixel when it was last fitted, (H, W)

    def fit_next(self, frame: Any, labels: Labels | None) -> Scene:
        """Fit a frame; without labels, the map of the frame before moves along the optical flow."""
        previous = self.image
        self.image, regions = check_image_and_regions(frame, labels)
        changed_pixels = torch.ones_like(self.image[0], dtype=torch.bool)
        if not self.frames:
            scene = self._fit_anew(regions)
        elif previous.shape != self.image.shape:
            name = f"frame {len(self.frames)}"
            raise InvalidArgument(name, f"shape {tuple(previous.shape)}", tuple(self.image.shape), verb="have")
        else:
            with threads_for_kernels(previous[0].numel()):
                scene, changed_pixels = self._follow(optical_flow(previous, self.image), regions)
        self.frames.append(scene)
        self.error = torch.where(changed_pixels, self._squared_error(scene), self.error)
        return scene

    def _squared_error(self, scene: Scene) -> Tensor:
        """Return the squared error of each pixel, (H, W)."""
        return renderer_of(scene, self.config).squared_error(Gaussians.of(scene.field), self.image)

    def _fit_anew(self, regions: RegionMap | None) -> Scene:
        """Fit a frame independently of other frames; some rows may stay unused."""
        config = self.config
        if self.frames:  # `stack` gives all contours the softness of the first frame
            config = config.model_copy(update={"softness": 0.0})
        count = check_num_gaussians(self.num_gaussians, self.image)
        scene = fit(self.image, regions, count, recipe=config, seed=self.seed).scene
        regions = scene.regions or regions  # a fit removes a map of one region
        return Scene(pad_rows(scene.field, count, regions), regions)

    def _follow(self, flow: Tensor, regions: RegionMap | None) -> tuple[Scene, Tensor]:
        """Fit a frame from the frame before; return its scene and the mask of the changed pixels."""
        first, before = self.frames[0].regions, self.frames[-1].regions
        is_moved = regions is None
        if first is not None and before is not None:
            labels = move_labels(flow, before.labels) if regions is None else regions.labels
            regions = first.relabel(labels, "mean")
        start, movable_rows, changed_pixels = self._start(flow, regions)
        if is_cut(self._squared_error(start), self.image):
            if is_moved and regions is not None:
                regions = regions.relabel(regions.labels.flatten().mode()[0].expand(regions.size))
            return self._fit_anew(regions), torch.ones_like(changed_pixels)
        if changed_pixels.any():
            anchor = regions.labels if regions is not None and self.config.move_contours else None
            descent = FrameDescent(self.image, start, self.config, movable_rows, changed_pixels)
            start = descent.run(_RELOCATIONS, anchor)
        return start, changed_pixels

    def _start(self, flow: Tensor, regions: RegionMap | None) -> tuple[Scene, Tensor, Tensor]:
        """Return the moved Gaussians of the frame before, the mask of movable rows, and the mask of changed pixels.

        A pixel changed if the unmoved Gaussians have a larger error around it than when they were fitted.
        """
        field = self.frames[-1].field
        still = Gaussians.of(field if regions is None else clear_lost_rows(field, regions))
        renderer = renderer_of(self.frames[-1], self.config)._replace(regions=regions)
        error = renderer.squared_error(still, self.image)
        changed_pixels = _local_mean(error) > _MAX_GROWTH * _local_mean(self.error) + _LEVEL
        _, sums = renderer.weight_sums(still)
        movable_rows = sums(changed_pixels[None].to(flow)) >= _MOVABLE_SHARE * sums(torch.ones_like(flow[:1]))
        means = torch.where(movable_rows[:, None], _move_means(flow, still, regions), still.means)
        moved = still._replace(means=means).field(renderer.size)
        return Scene(moved, regions), movable_rows, changed_pixels


def _local_mean(error: Tensor) -> Tensor:
    return avg_pool2d(error[None], _WINDOW, 1, _WINDOW // 2, count_include_pad=False)[0]


def _move_means(flow: Tensor, gaussians: Gaussians, regions: RegionMap | None) -> Tensor:
    """Move centres along the flow; a centre that would leave its region moves as the region does on average."""
    means, region_ids = gaussians.means, gaussians.region_ids
    new_means = move_points(flow, means)
    if regions is None or region_ids is None:
        return new_means
    pixels = regions.index_of(regions.labels).flatten()
    sums = torch.stack([pixels.bincount(offsets.flatten()) for offsets in flow], -1)
    mean = sums / pixels.bincount()[:, None]
    inside = lookup_regions(new_means, regions.labels) == region_ids
    return torch.where(inside[:, None], new_means, means - mean[regions.index_of(region_ids)].to(new_means))


def _pair(frames: Iterable[Any], label_maps: Labels | Iterable[Labels] | None) -> Iterator[tuple[Any, Labels | None]]:
    """Yield each frame with its label map, or with None: after a single map, or if there are no maps."""
    maps: Iterator[Labels | None]
    expected = "label_maps must have a map for each frame, or be one map; got"
    if label_maps is None:
        maps = repeat(None)
    elif isinstance(label_maps, RegionMap) or (isinstance(label_maps, Tensor | np.ndarray) and label_maps.ndim == 2):
        maps = chain([label_maps], repeat(None))
    else:
        if isinstance(frames, Sized) and isinstance(label_maps, Sized) and len(label_maps) != len(frames):
            raise ValueError(f"{expected} {len(label_maps)} for {len(frames)} frames")
        maps = iter(label_maps)
    for number, frame in enumerate(frames):
        try:
            yield frame, next(maps)
        except StopIteration:
            raise ValueError(f"{expected} {number}") from None
