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

from kcgs._check import check_count
from kcgs._progress import Progress
from kcgs.fitting import FitConfig, fit
from kcgs.fitting.loop import check_problem
from kcgs.fitting.state import Gaussians
from kcgs.functional import RegionMap, lookup_regions
from kcgs.kernels import prepare, threads_for_kernels
from kcgs.nn import GaussianField
from kcgs.scene import Scene, load, save

from .descent import Descent, region_errors, region_positions
from .motion import estimate_motion, move_labels, move_points

OnFrame = Callable[[int, Scene], bool | None]
Labels = RegionMap | Tensor | NDArray[Any]

# frames per second where nothing says so
_FRAME_RATE = 24.0
# a start whose squared error is more than this share of the frame's variance is a scene cut
_CUT = 0.5
# iterations before which the least useful rows are relocated, and the share that is
_RELOCATIONS = dict.fromkeys((0, 20, 40, 60, 80), 0.05)
# a region stands still if its error without motion is at most so many times that of its fit
_STILL = 1.05
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
    move, the least useful 5 % are relocated five times, and all descend a little. A region that is explained as well as
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
        on_frame: called after every frame with its number, from 0, and its scene; returning True stops.
        progress: show how many frames are done.
        checkpoint: a .safetensors file to write the frames to, every eighth and the last, whole or not at all.
        resume: go on after the last frame of `checkpoint`, where it exists; the result is that of an uninterrupted fit.
        settings: fields of :class:`kcgs.FitConfig`, in place of the recipe's.

    Returns:
        Scenes: a field of T x N Gaussians, T label maps if there are any, and ``metadata["frame_rate"]``, in frames
        per second: that of `frames`, or 24.

    Raises:
        TypeError: wrong types.
        ValueError: as :func:`kcgs.fit`; no frames; a frame of another size, or without a label map; a checkpoint of
            other frames or another N.

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
        raise ValueError("resume needs checkpoint, a file to go on from; got None")
    path = None if checkpoint is None else Path(checkpoint)
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
            if is_new and on_frame is not None and on_frame(number, video.scenes[-1]):
                break
    if not video.scenes:
        raise ValueError("frames must hold at least one frame; got none")
    scenes = video.batch(metadata)
    if path is not None:
        save(path, scenes)
    return scenes


class _Video:
    """The frames that are done, and what the next one starts from."""

    def __init__(self, config: FitConfig, num_gaussians: int, seed: int) -> None:
        self.config, self.num_gaussians, self.seed = config, num_gaussians, seed
        self.scenes: list[Scene] = []
        self.image: Tensor | None = None
        self.errors: dict[int, float] = {}  # of each region, when its Gaussians were last fitted

    def add(self, frame: Any, labels: Labels | None, done: Scene | None) -> None:
        """Fit a frame, unless it is done; labels None: the map before is carried on, where there is one."""
        before, number = self.image, len(self.scenes)
        self.image, regions = check_problem(frame, labels)
        if before is not None and before.shape != self.image.shape:
            raise ValueError(f"frame {number} must have shape {tuple(before.shape)}; got {tuple(self.image.shape)}")
        if done is not None:
            if (*done.size, done.field.colors.shape[-1]) != (*self.image.shape[1:], len(self.image)):
                raise ValueError(f"checkpoint must be of these frames; frame {number} has another shape there")
            scene = done
        elif before is None:
            scene = self._fit_anew(self.image, regions)
        else:
            prepare(self.config.backend, before.device, before.dtype, len(before))
            with threads_for_kernels(before[0].numel()):
                scene = self._follow(before, self.image, regions)
        self.scenes.append(scene)
        self._remember_errors()

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
        scene = fit(image, regions, self.num_gaussians, recipe=self.config, seed=self.seed).scene
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

    def _follow(self, previous: Tensor, image: Tensor, regions: RegionMap | None) -> Scene:
        """Fit a frame from the one before."""
        scene, first = self.scenes[-1], self.scenes[0].regions
        motion, is_carried = estimate_motion(previous, image), regions is None
        if first is not None and scene.regions is not None:
            labels = move_labels(motion, scene.regions.labels) if regions is None else regions.labels
            regions = first.relabel(labels, "mean")
        start, still = self._choose_start(image, motion, regions)
        descent = Descent(image, start, self.config, still)
        if bool(descent.squared_error().mean() > _CUT * image.var((1, 2)).mean()):
            if is_carried and regions is not None:
                largest = regions.index_of(regions.labels).flatten().bincount().argmax()
                regions = RegionMap.from_labels(torch.full_like(regions.labels, int(regions.ids[largest])))
            return self._fit_anew(image, regions)
        if not still.all():
            start = descent.run(_RELOCATIONS, None if regions is None else regions.labels)
        return start.scene(scene.size)

    def _choose_start(self, image: Tensor, motion: Tensor, regions: RegionMap | None) -> tuple[Gaussians, Tensor]:
        """Return the Gaussians before, moved where that explains a region better, and which regions stand still.

        These are explained, without motion, as well as when their Gaussians were last fitted.
        """
        before = _gaussians(self.scenes[-1])
        unmoved = before._replace(regions=regions)
        if regions is not None and before.region_ids is not None:  # rows of a region that is no longer there are free
            present = torch.isin(before.region_ids, regions.ids)
            unmoved = unmoved._replace(
                region_ids=torch.where(present, before.region_ids, regions.ids[0]),
                colors=torch.where(present[:, None], before.colors, 0.0),
            )
        moved = unmoved._replace(means=_move_by_region(motion, unmoved))
        errors = [region_errors(image, gaussians, self.config) for gaussians in (unmoved, moved)]
        moves = (errors[1] < errors[0])[region_positions(unmoved, image)[0]]
        start = unmoved._replace(means=torch.where(moves[:, None], moved.means, unmoved.means))
        fitted = [self.errors.get(region, 0.0) for region in _ids(regions)]
        return start, errors[0] <= _STILL * errors[0].new_tensor(fitted)

    def _remember_errors(self) -> None:
        """Keep the errors of the regions whose Gaussians are not those of the frame before."""
        assert self.image is not None
        now = _gaussians(self.scenes[-1])
        ids = _ids(now.regions)
        changed = torch.ones(len(ids), dtype=torch.bool)
        if len(self.scenes) > 1:
            before = _gaussians(self.scenes[-2])
            rows = torch.zeros_like(now.means[:, 0], dtype=torch.bool)
            for old, new in zip(before[:3], now[:3], strict=True):
                rows |= (old != new).any(-1)
            changed = region_positions(now, self.image)[0][rows].bincount(minlength=len(ids)) > 0
        errors = region_errors(self.image, now, self.config).tolist()
        for region, error, is_new in zip(ids, errors, changed.tolist(), strict=True):
            if is_new or region not in self.errors:
                self.errors[region] = error


def _gaussians(scene: Scene) -> Gaussians:
    field = scene.field
    return Gaussians(
        field.means.detach(), field.cholesky.detach(), field.colors.detach(), field.region_ids, scene.regions
    )


def _ids(regions: RegionMap | None) -> list[int]:
    return [0] if regions is None else regions.ids.tolist()


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
