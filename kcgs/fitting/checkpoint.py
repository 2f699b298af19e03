"""A fit that was killed goes on where it stood."""

from __future__ import annotations

import hashlib
import os
import pickle
import time
from pathlib import Path
from typing import Any

import torch

from kcgs._atomic import atomic_path, check_writable
from kcgs.functional import RegionMap

from .state import FitState, Gaussians, HistoryEntry

# a checkpoint is written when the fit has run this many times as long as the last one took to write
_PATIENCE = 100.0
_VERSION = 5
_KEPT = ("cutoff", "region_ids", "anchor", "iteration", "first", "wanted", "densifications", "late_moves")


class Checkpoint:
    """A file that holds a fit's state, written whole or not at all, and only by the problem that it belongs to."""

    def __init__(self, path: str | os.PathLike[str], state: FitState, given: RegionMap | None) -> None:
        self.path = Path(path)
        check_writable("checkpoint", path)
        self.problem = _fingerprint(state, given)
        self._next = 0.0

    def due(self) -> bool:
        """Say whether it is time to write; writing costs about a hundredth of the fit."""
        return time.perf_counter() >= self._next

    def write(self, state: FitState) -> None:
        """Put the state in the file's place."""
        start = time.perf_counter()
        with atomic_path(self.path) as temporary, temporary.open("wb") as file:
            torch.save({"problem": self.problem, **_plain(state)}, file)
        end = time.perf_counter()
        self._next = end + _PATIENCE * (end - start)

    def read_into(self, state: FitState) -> None:
        """Take up the state of the file, if there is one; refuse what is damaged or another problem's."""
        if not self.path.exists():
            return
        try:
            kept = torch.load(self.path, weights_only=True)
            problem = kept["problem"]
        except (RuntimeError, pickle.UnpicklingError, EOFError, KeyError, TypeError, ValueError) as error:
            raise ValueError(f"checkpoint {str(self.path)!r} is damaged, or no checkpoint of a fit") from error
        if problem != self.problem:
            raise ValueError(
                f"checkpoint {str(self.path)!r} belongs to another fit: image, regions, settings, num_gaussians and "
                "seed must be those it was written with"
            )
        _take_up(state, kept)


def _fingerprint(state: FitState, given: RegionMap | None) -> str:
    size = tuple(state.image.shape)
    # a fit that goes on may be granted more time
    settings = state.config.model_dump_json(exclude={"max_seconds"})
    digest = hashlib.sha256(f"{_VERSION} {settings} {state.num_gaussians} {state.seed} {size}".encode())
    digest.update(state.image.cpu().numpy().tobytes())
    if given is not None:
        digest.update(repr(given.softness).encode())
        digest.update(given.labels.cpu().numpy().tobytes())
    return digest.hexdigest()


def _plain(state: FitState) -> dict[str, Any]:
    """Use nothing but tensors, numbers, strings, lists and dicts, which load without running code."""
    return {
        **{name: getattr(state, name) for name in _KEPT},
        "optimizer": state.optimizer.state_dict(),
        "regions": None if state.regions is None else state.regions.state(),
        "seconds": state.seconds(),
        "history": [tuple(entry) for entry in state.history],
        "best_score": state.best_score,
        "best": None if state.best is None else state.best[:4],
        "best_regions": None if state.best is None or state.best.regions is None else state.best.regions.state(),
    }


def _take_up(state: FitState, kept: dict[str, Any]) -> None:
    for name in (*_KEPT, "best_score"):
        setattr(state, name, kept[name])
    state.optimizer.load_state_dict(kept["optimizer"])
    state.regions, best_regions = (
        None if kept[name] is None else RegionMap.from_state(kept[name]) for name in ("regions", "best_regions")
    )
    state.started = time.perf_counter() - kept["seconds"]
    state.history = [HistoryEntry(*entry) for entry in kept["history"]]
    if kept["best"] is not None:
        means, cholesky, colors, region_ids = kept["best"]
        state.best = Gaussians(means, cholesky, colors, region_ids, best_regions)
