"""Room for the lists of a plan where the host does not wait for the device: in a CUDA graph, and in steps of a fit.

An eager plan reads its number of slots from the device. Elsewhere the lists have room for 1.5 times the largest number
of slots seen for the image size, plus 65,536, since the number grows fastest where Gaussians are few and wide. A plan
that does not fit, or whose values are not finite, renders NaN and adds to counters on the device. The next eager plan
reads and reports the counters of CUDA graphs; `settle` reads the counters of a fit.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch
from torch import Tensor

from kcgs._warn import warn_user

from ..interface import SplatInputs

# room in units of the largest number of slots seen, and slots of room besides
_ROOM_FACTOR = 1.5
_SPARE_SLOTS = 1 << 16
# the programs count slots in 32 bits
_SLOT_LIMIT = (1 << 31) - 1

# slots of the largest plan of a device, a number of images and a size
_max_slots: dict[tuple[torch.device, int, tuple[int, int]], int] = {}
# int64 counters, by device and whether plans wait (False: within `without_waiting`): plans whose lists did not fit,
# plans whose values were not finite, and the most slots of a plan
_notes: dict[tuple[torch.device, bool], Tensor] = {}
_waits: ContextVar[bool] = ContextVar("whether plans wait for the device", default=True)


@contextmanager
def without_waiting() -> Iterator[None]:
    """Plan without waiting for the device, as in a CUDA graph; the first plan of a size still waits."""
    token = _waits.set(False)
    try:
        yield
    finally:
        _waits.reset(token)


def reserve(inputs: SplatInputs) -> int | None:
    """Return the number of slots to make room for; None: the plan waits for their number."""
    captured = inputs.means.is_cuda and torch.cuda.is_current_stream_capturing()
    if _waits.get() and not captured:
        return None
    most = _max_slots.get((inputs.means.device, inputs.num_images, inputs.size))
    if captured and most is None:
        images, (height, width) = inputs.num_images, inputs.size
        raise RuntimeError(
            f"region_splat of {images} x {height} x {width} cannot be captured before it was rendered once: the room "
            "for its lists is not known; call it before the capture, with Gaussians as large as there will be"
        )
    return None if most is None else min(int(_ROOM_FACTOR * most) + _SPARE_SLOTS, _SLOT_LIMIT)


def remember(inputs: SplatInputs, slots: int) -> None:
    """Make room, from now on, for plans of so many slots."""
    _raise_room((inputs.means.device, inputs.num_images, inputs.size), slots)


@contextmanager
def room_for(inputs: SplatInputs, slots: int) -> Iterator[None]:
    """Turn a lack of memory for so many slots into a ValueError that says why there are so many."""
    if slots > _SLOT_LIMIT:
        raise _too_many(inputs, slots)
    try:
        yield
    except torch.OutOfMemoryError as error:
        raise _too_many(inputs, slots) from error


def _too_many(inputs: SplatInputs, slots: int) -> ValueError:
    count, (height, width) = inputs.colors.shape[:-1].numel(), inputs.size
    return ValueError(
        f"{count} Gaussians touch {slots} tiles of 16 x 16 pixels at {height} x {width}: more than the device has room "
        "for; they are too wide, or too many, for an image of this size"
    )


def reports() -> bool:
    """Return whether an eager plan reads and reports the counters; within `without_waiting`, `settle` reads them."""
    return _waits.get()


def report(full: int, not_finite: int, most: int) -> None:
    """Warn where counters are not 0."""
    if full:
        warn_user(
            f"{full} renders of a CUDA graph are NaN: their Gaussians touch up to {most} tiles of 16 x 16 pixels, and "
            "there was room for fewer; capture the graph anew, after a render of such Gaussians"
        )
    if not_finite:
        warn_user(f"{not_finite} renders of a CUDA graph are NaN: their Gaussians were not finite, or out of range")


def settle(device: torch.device, num_images: int, size: tuple[int, int]) -> bool:
    """Make room for plans of `without_waiting` that did not fit since the last call; return whether any failed."""
    notes = _notes.get((device, False))
    if notes is None:
        return False
    full, not_finite, most = notes.tolist()
    notes.zero_()
    _raise_room((device, num_images, size), most)
    return bool(full or not_finite)


def notes_of(device: torch.device) -> Tensor:
    """Return the counters of a device, for plans that wait or for plans that do not."""
    key = device, _waits.get()
    if key not in _notes:
        with torch.inference_mode(False):
            _notes[key] = torch.zeros(3, dtype=torch.int64, device=device)
    return _notes[key]


def _raise_room(key: tuple[torch.device, int, tuple[int, int]], slots: int) -> None:
    _max_slots[key] = max(slots, _max_slots.get(key, 0))
