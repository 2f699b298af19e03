"""Fits of a video: frames in, a batch of scenes out, in which a row is the same Gaussian from frame to frame."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sized
from itertools import chain, repeat
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d

from kcgs._check import check_count
from kcgs._progress import Progress
from kcgs.errors import InvalidArgument
from kcgs.fitting import FitConfig, fit
from kcgs.fitting.loop import check_problem
from kcgs.fitting.state import Gaussians
from kcgs.functional import RegionMap, lookup_regions
from kcgs.kernels import prepare, threads_for_kernels
from kcgs.nn import GaussianField
from kcgs.scene import Scene, load, save

from .descent import Descent, region_positions, render_draft, sum_over_pixels
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
# frames between two writes of a checkpoint
_CHECKPOINT_FRAMES = 8


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
    checkpoint: str | os.PathLike[str] | None = None,
    resume: bool = False,
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
        checkpoint: a .safetensors file to write the frames to, every eighth and the last, whole or not at all.
        resume: go on after the last frame of `checkpoint`, where it exists; the result is that of an uninterrupted fit.
            Frames, label maps and settings must be the same; only N and the shape of the frames are compared.
        settings: fields of :class:`kcgs.FitConfig`, in place of the recipe's.

    Returns:
        Scenes: a field of T x N Gaussians, T label maps if there are any, and ``metadata["frame_rate"]``, in frames
        per second: that of `frames`, or 24.

    Raises:
        TypeError: wrong types.
        ValueError: as :func:`kcgs.fit`; no frames; a frame of another size, or without a label map; a checkpoint of
            another shape or N.

    Example:
        >>> frames = [torch.zeros(3, 16, 24) for _ in range(3)]
        >>> for t, frame in enumerate(frames):
        ...     frame[:, 4:12, 4 + t : 12 + t] = 1.0
        >>> scenes = fit_video(frames, num_gaussians=8, iterations=100)
        >>> len(scenes), scenes.num_gaussians, scenes.render().shape
        (3, 8, torch.Size([3, 3, 16, 24]))
    """
    config = FitConfig.from_recipe(recipe, **({"merge_regions": False} | settings))
    count = check_count("num_gaussians", num_gaussians)
    if resume and checkpoint is None:
        raise InvalidArgument("checkpoint", "a file to go on from, with resume", None)
    path = None if checkpoint is None else Path(checkpoint)
    if path is not None and path.suffix != ".safetensors":
        raise InvalidArgument("checkpoint", ".safetensors", repr(str(path)), verb="end in")
    done = _read_checkpoint(path, count) if path is not None and resume else []
    metadata = {"frame_rate": f"{float(getattr(frames, 'frame_rate', _FRAME_RATE)):.10g}"}
    length = len(frames) if isinstance(frames, Sized) else None
    video = _Video(config, count, seed)
    with Progress("fit-video", known=length is not None, shown=progress) as bar:
        for number, (frame, labels) in enumerate(_pairs(frames, label_maps if config.guidance else None)):
            is_new = number >= len(done)
            video.add(frame, labels, None if is_new else done[number])
            bar.update((number + 1) / (length or math.inf), f"frame {number + 1}")
            if is_new and path is not None and (number + 1) % _CHECKPOINT_FRAMES == 0:
                save(path, video.batch(metadata))
            if on_frame is not None and on_frame(number, video.scenes[-1]):
                break
    if not video.scenes:
        raise ValueError("frames must hold at least one frame; got none")
    scenes = video.batch(metadata)
    if path is not None and len(scenes) > len(done):
        save(path, scenes)
    return scenes


class _Video:
    """The frames that are done, and what the next one starts from."""

    def __init__(self, config: FitConfig, num_gaussians: int, seed: int) -> None:
        self.config, self.num_gaussians, self.seed = config, num_gaussians, seed
        self.scenes: list[Scene] = []
        self.image: Tensor | None = None
        self.error = torch.zeros(())  # of each pixel, (H, W), when it was last fitted

    def add(self, frame: Any, labels: Labels | None, done: Scene | None) -> None:
        """Fit a frame, unless it is done; labels None: the map before is carried on, where there is one."""
        before, number = self.image, len(self.scenes)
        self.image, regions = check_problem(frame, labels)
        if before is not None and before.shape != self.image.shape:
            raise ValueError(f"frame {number} must have shape {tuple(before.shape)}; got {tuple(self.image.shape)}")
        if done is not None and (*done.size, done.field.colors.shape[-1]) != (*self.image.shape[1:], len(self.image)):
            raise ValueError(f"checkpoint must be of these frames; frame {number} has another shape there")
        changed = torch.ones_like(self.image[0], dtype=torch.bool)
        if before is None:
            scene = self._fit_anew(self.image, regions) if done is None else done
        else:
            prepare(self.config.backend, before.device, before.dtype, len(before))
            with threads_for_kernels(before[0].numel()):
                scene, changed = self._follow(before, self.image, regions, done)
        self.scenes.append(scene)
        field = scene.field
        tensors = field.means.detach(), field.cholesky.detach(), field.colors.detach()
        error = self._squared_error(self.image, Gaussians(*tensors, field.region_ids, scene.regions))
        self.error = torch.where(changed, error, self.error)

    def batch(self, metadata: Mapping[str, str]) -> Scene:
        """Return all frames as one scene."""
        fields = [scene.field for scene in self.scenes]
        means, cholesky, colors = (
            torch.stack([getattr(field, name).detach() for field in fields]) for name in ("means", "cholesky", "colors")
        )
        size = fields[0].size
        maps = [scene.regions for scene in self.scenes if scene.regions is not None]
        if not maps:
            return Scene(GaussianField(means, cholesky, colors, size=size), None, metadata)
        ids = torch.stack([field.region_ids for field in fields if field.region_ids is not None])
        # the same pair has the same width in all frames
        widths: dict[tuple[int, int], float] = {}
        for regions in maps:
            widths |= regions.softness if isinstance(regions.softness, Mapping) else {}
        softness = widths or maps[0].softness
        stacked = RegionMap.from_labels(torch.stack([regions.labels for regions in maps]), softness)
        return Scene(GaussianField(means, cholesky, colors, ids, size=size), stacked, metadata)

    def _fit_anew(self, image: Tensor, regions: RegionMap | None) -> Scene:
        """Fit a frame by itself; rows that it leaves unused have colour 0."""
        config = self.config
        if self.scenes and regions is not None:  # contours have the widths of the first frame
            assert self.scenes[0].regions is not None
            regions = self.scenes[0].regions.relabel(regions.labels, "mean")
            config = config.model_copy(update={"softness": 0.0})
        scene = fit(image, regions, self.num_gaussians, recipe=config, seed=self.seed).scene
        field, missing = scene.field, self.num_gaussians - scene.num_gaussians
        unused = torch.tensor([field.size[1] / 2, field.size[0] / 2]), torch.tensor([1.0, 0.0, 1.0]), torch.zeros(1)
        means, cholesky, colors = (
            torch.cat([rows.detach(), row.to(rows).expand(missing, rows.shape[1])])
            for rows, row in zip((field.means, field.cholesky, field.merged_colors()), unused, strict=True)
        )
        if regions is None:
            return Scene(GaussianField(means, cholesky, colors, size=field.size))
        regions = regions if scene.regions is None else scene.regions  # None: there is one region
        ids = regions.ids[:1].expand(self.num_gaussians).clone()
        if field.region_ids is not None:
            ids[: field.num_gaussians] = field.region_ids
        return Scene(GaussianField(means, cholesky, colors, ids, size=field.size), regions)

    def _follow(
        self, previous: Tensor, image: Tensor, regions: RegionMap | None, done: Scene | None
    ) -> tuple[Scene, Tensor]:
        """Return a frame, fitted from the one before unless it is done, and which pixels changed."""
        scene, first = self.scenes[-1], self.scenes[0].regions
        motion, is_carried = estimate_motion(previous, image), regions is None
        if first is not None and scene.regions is not None:
            labels = move_labels(motion, scene.regions.labels) if regions is None else regions.labels
            regions = first.relabel(labels, "mean")
        start, free, changed = self._choose_start(image, motion, regions)
        if done is not None:
            return done, changed
        descent = Descent(image, start, self.config, free, changed)
        if bool(descent.squared_error().mean() > _CUT * image.var((1, 2)).mean()):
            if is_carried and regions is not None:
                largest = regions.index_of(regions.labels).flatten().bincount().argmax()
                regions = regions.relabel(torch.full_like(regions.labels, int(regions.ids[largest])))
            return self._fit_anew(image, regions), torch.ones_like(changed)
        if changed.any():
            start = descent.run(_RELOCATIONS, None if regions is None else regions.labels)
        return start.scene(scene.size), changed

    def _choose_start(
        self, image: Tensor, motion: Tensor, regions: RegionMap | None
    ) -> tuple[Gaussians, Tensor, Tensor]:
        """Return the Gaussians before, moved where that helps, which of them may move on, and which pixels changed.

        A pixel changed if the Gaussians, without motion, explain its surroundings less well than when they were fitted.
        A region moves if it is explained better with motion.
        """
        field = self.scenes[-1].field
        means, cholesky, colors = (t.detach() for t in (field.means, field.cholesky, field.colors))
        ids = field.region_ids
        if regions is not None and ids is not None:  # rows of a region that is no longer there have no use
            present = torch.isin(ids, regions.ids)
            ids, colors = torch.where(present, ids, regions.ids[0]), torch.where(present[:, None], colors, 0.0)
        unmoved = Gaussians(means, cholesky, colors, ids, regions)
        moved = unmoved._replace(means=_move_by_region(motion, unmoved))
        errors = [self._squared_error(image, gaussians) for gaussians in (unmoved, moved)]
        changed = _blur(errors[0]) > _STILL * _blur(self.error) + _LEVEL
        _, sums = sum_over_pixels(unmoved, image, self.config)
        free = sums(changed[None].to(image)) >= _FREE_SHARE * sums(torch.ones_like(image[:1]))
        rows, pixels = region_positions(unmoved, image)
        moves = pixels.flatten().bincount((errors[1] - errors[0]).flatten()) < 0
        means = torch.where((free & moves[rows])[:, None], moved.means, means)
        return unmoved._replace(means=means), free, changed

    def _squared_error(self, image: Tensor, gaussians: Gaussians) -> Tensor:
        return (render_draft(gaussians, image, self.config) - image).square().mean(0)


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


def _read_checkpoint(path: Path, num_gaussians: int) -> list[Scene]:
    """Return the frames of a checkpoint, none where there is no file."""
    if not path.exists():
        return []
    scenes = load(path)
    if scenes.field.means.ndim != 3 or scenes.num_gaussians != num_gaussians:
        raise ValueError(f"checkpoint must hold frames of {num_gaussians} Gaussians; {str(path)!r} is {scenes!r}")
    return list(scenes)
