"""Edits of scenes that take clips, too."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from typing import Any, Concatenate, ParamSpec, Protocol, overload

from kcgs.clip import Clip
from kcgs.scene import Scene

from .checks import check_field, ids_of

P = ParamSpec("P")
Ids = int | Iterable[int]


class _Edit(Protocol[P]):
    """An edit of a scene, which gives a scene, or of a clip, which gives a clip."""

    @overload
    def __call__(self, scene: Scene, region_ids: Ids, *args: P.args, **kwargs: P.kwargs) -> Scene: ...
    @overload
    def __call__(self, scene: Clip, region_ids: Ids, *args: P.args, **kwargs: P.kwargs) -> Clip: ...


def takes_clips(function: Callable[Concatenate[Scene, Ids, P], Scene], *, by_gaussians: bool = False) -> _Edit[P]:
    """Let an edit take a clip: it edits every frame that has any of the regions, and leaves the others as they are.

    Where no frame has any, it is refused as by the first frame. A frame has a region if its map has, or its Gaussians.
    """

    @functools.wraps(function)
    def edit(scene: Any, region_ids: Ids, *args: P.args, **kwargs: P.kwargs) -> Any:
        if not isinstance(scene, Clip):
            return function(scene, region_ids, *args, **kwargs)
        # every frame goes through it
        wanted = list(region_ids) if isinstance(region_ids, Iterable) else [region_ids]
        edited = 0

        def edit_frame(frame: Scene) -> Scene:
            nonlocal edited
            field, regions = check_field(frame), frame.regions
            known = ids_of(field) if by_gaussians or regions is None else regions.ids
            if not (present := [region for region in wanted if region in set(known.tolist())]):
                return frame
            edited += 1
            return function(frame, present, *args, **kwargs)

        clip = scene.edit(edit_frame)
        if not edited:
            function(scene[0], wanted, *args, **kwargs)
        return clip

    return edit
