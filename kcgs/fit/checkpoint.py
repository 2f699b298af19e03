"""A fit that was killed goes on where it stood."""

from __future__ import annotations

import hashlib
import os
import pickle
import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kcgs._atomic import atomic_path
from kcgs.functional import RegionMap

from .config import FitConfig
from .monitor import Gaussians, HistoryEntry

# a checkpoint is written when the fit has run this many times as long as the last one took to write
_PATIENCE = 100.0
_VERSION = 1


class Checkpoint:
    """A file that holds a fit's state, written whole or not at all, and only by the problem that it belongs to."""

    def __init__(
        self,
        path: str | os.PathLike[str],
        image: Tensor,
        regions: RegionMap | None,
        config: FitConfig,
        num_gaussians: int,
        seed: int,
    ) -> None:
        self.path = Path(path)
        if not self.path.resolve().parent.is_dir():
            raise FileNotFoundError(f"checkpoint needs an existing folder; {str(self.path.parent)!r} is not there")
        self.problem = _fingerprint(image, regions, config, num_gaussians, seed)
        self._next = 0.0

    def due(self) -> bool:
        """Say whether it is time to write; writing costs about a hundredth of the fit."""
        return time.perf_counter() >= self._next

    def write(self, state: dict[str, Any]) -> None:
        """Put the state in the file's place."""
        start = time.perf_counter()
        with atomic_path(self.path) as temporary, temporary.open("wb") as file:
            torch.save({"version": _VERSION, "problem": self.problem, **_plain(state)}, file)
        end = time.perf_counter()
        self._next = end + _PATIENCE * (end - start)

    def read(self) -> dict[str, Any] | None:
        """Return the state, or None where there is no file yet.

        Raises:
            ValueError: the file is not a checkpoint, or that of another problem.
        """
        if not self.path.exists():
            return None
        try:
            state = torch.load(self.path, weights_only=True)
            version, problem = state["version"], state["problem"]
        except (RuntimeError, pickle.UnpicklingError, EOFError, KeyError, TypeError, ValueError) as error:
            raise ValueError(f"checkpoint {str(self.path)!r} is damaged, or no checkpoint of a fit") from error
        if version != _VERSION or problem != self.problem:
            raise ValueError(
                f"checkpoint {str(self.path)!r} belongs to another fit: image, regions, settings, num_gaussians and "
                "seed must be those it was written with"
            )
        return _rich(state)


def _fingerprint(image: Tensor, regions: RegionMap | None, config: FitConfig, num_gaussians: int, seed: int) -> str:
    digest = hashlib.sha256(f"{config.model_dump_json()} {num_gaussians} {seed} {tuple(image.shape)}".encode())
    digest.update(image.cpu().numpy().tobytes())
    if regions is not None:
        labels, *rest = _plain_map(regions)
        digest.update(repr(rest).encode())
        digest.update(labels.cpu().numpy().tobytes())
    return digest.hexdigest()


def _plain(state: dict[str, Any]) -> dict[str, Any]:
    """Use nothing but tensors, numbers, strings, lists and dicts, which load without running code."""
    best = state["monitor"]["best"]
    monitor = {**state["monitor"], "history": [tuple(h) for h in state["monitor"]["history"]]}
    monitor["best"] = None if best is None else (*best[:4], _plain_map(best.regions))
    return {**state, "drawn": _plain_map(state["drawn"]), "monitor": monitor}


def _rich(state: dict[str, Any]) -> dict[str, Any]:
    monitor = state["monitor"]
    monitor["history"] = [HistoryEntry(*h) for h in monitor["history"]]
    if monitor["best"] is not None:
        means, cholesky, colors, ids, drawn = monitor["best"]
        monitor["best"] = Gaussians(means, cholesky, colors, ids, _rich_map(drawn))
    return {**state, "drawn": _rich_map(state["drawn"])}


def _plain_map(regions: RegionMap | None) -> Any:
    if regions is None:
        return None
    softness = regions.softness
    pairs = softness if isinstance(softness, float) else [(*pair, width) for pair, width in softness.items()]
    return regions.fine_labels, pairs, regions.supersample


def _rich_map(plain: Any) -> RegionMap | None:
    if plain is None:
        return None
    labels, pairs, supersample = plain
    softness = pairs if isinstance(pairs, float) else {(int(a), int(b)): width for a, b, width in pairs}
    return RegionMap.from_labels(labels, softness, supersample=supersample)
