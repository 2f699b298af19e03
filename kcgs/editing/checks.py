"""What an edit may be asked for."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import kcgs.scene
from kcgs._check import check_count, check_floating, check_number
from kcgs.errors import InvalidArgument, InvalidArgumentType
from kcgs.functional import RegionMap
from kcgs.nn import GaussianField
from kcgs.scene import Scene, check_unbatched

Numbers = Tensor | NDArray[Any] | Sequence[Any] | float
Fill = Literal["inpaint"]


def check_field(scene: Scene) -> GaussianField:
    """Return the field of a scene whose Gaussians have region ids."""
    if not isinstance(scene, Scene):
        raise TypeError(f"scene must be a Scene; got {type(scene).__name__}")
    if scene.field.region_ids is None:
        raise ValueError("scene must have region ids; call scene.field.assign_regions(regions)")
    return scene.field


def check_scene(scene: Scene, region_ids: object) -> tuple[RegionMap, Tensor]:
    """Return the map and the ids as a tensor on its device."""
    check_field(check_unbatched(scene))
    regions = kcgs.scene.check_scene(scene).regions
    if regions is None:
        raise InvalidArgument("scene", "a label map", "regions None", verb="have")
    wanted = check_ids(region_ids, regions.ids, "map")
    return regions, torch.tensor(wanted, device=regions.ids.device)


def check_editable(scene: Scene, region_ids: object) -> tuple[RegionMap, Tensor]:
    """Return what `check_scene` does, if the map may change and a region is left."""
    regions, chosen = check_scene(scene, region_ids)
    if regions.resized:
        raise ValueError("scene must not have a resized map: edit the map at its own size, then resize it")
    if regions.num_regions == len(chosen):
        raise ValueError(f"region_ids must leave a region that takes over pixels; got all {len(chosen)} regions")
    return regions, chosen


def check_ids(region_ids: object, known: Tensor, owner: str) -> list[int]:
    """Return the ids, each once, sorted, if all are known."""
    several = region_ids if isinstance(region_ids, Iterable) else [region_ids]
    wanted = sorted({check_count("region_ids", region, 0) for region in several})
    if not wanted:
        raise ValueError("region_ids must hold an id; got none")
    ids = known.unique().tolist()
    for region in wanted:
        if region not in ids:
            shown = ", ".join(map(str, ids[:20])) + (" ..." if len(ids) > 20 else "")
            raise InvalidArgument("region_ids", f"among the {len(ids)} ids of the {owner}, {shown}", region)
    return wanted


def check_offset(offset: Sequence[float]) -> tuple[int, int]:
    """Return the offset in whole pixels."""
    pair = offset.tolist() if isinstance(offset, Tensor | np.ndarray) else offset
    if not isinstance(pair, Sequence) or isinstance(pair, str):
        raise InvalidArgumentType("offset", "(dx, dy) in pixels", repr(offset))
    if len(pair) != 2:
        raise InvalidArgument("offset", "(dx, dy)", repr(offset))
    steps = [check_number("offset", d) for d in pair]
    if any(abs(step) > 1e8 or abs(step - round(step)) > 1e-6 for step in steps):
        raise InvalidArgument("offset", "whole multiples of 1 pixel", repr(offset))
    return round(steps[0]), round(steps[1])


def check_fill(fill: object) -> None:
    """Refuse what is no way to fill a hole."""
    if fill is not None and fill != "inpaint":
        raise InvalidArgument("fill", '"inpaint" or None', repr(fill))


def color_tensor(name: str, value: Numbers, colors: Tensor, shapes: list[tuple[int, ...]]) -> Tensor:
    """Return numbers of one of these shapes in the dtype and on the device of the colours."""
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


def ids_of(field: GaussianField) -> Tensor:
    """Return the region ids that `check_field` has seen."""
    assert field.region_ids is not None
    return field.region_ids
