"""Checkpoints: a fit that was killed continues from the last one."""

from __future__ import annotations

import hashlib
import io
import os
import time
from dataclasses import fields
from pathlib import Path
from typing import Any

import torch

from kcgs._atomic import check_writable, write_file
from kcgs.maps import RegionMap
from kcgs.nn import GaussianField
from kcgs.scene import Scene

from .best import Best
from .checkpoint_0_3 import from_0_3, problems_of_0_3
from .problem import Problem
from .result import HistoryEntry
from .start import make_state
from .state import FitState

# seconds between two checkpoints, per second that the first of them took to write
_RUN_PER_WRITE = 100.0
_VERSION = 13
_DIGEST_SIZE = 32  # bytes of the SHA-256 of the content, which begins the file


class Checkpoint:
    """A file with a fit's state: written atomically, and read only for the same problem."""

    def __init__(self, path: str | os.PathLike[str], problem: Problem) -> None:
        check_writable("checkpoint", path)
        self.path, self.problem = Path(path), problem
        self._next_write = 0.0

    def is_due(self, state: FitState) -> bool:
        """True at the last iteration, and often enough before that writing takes about 1 % of the fit."""
        return time.perf_counter() >= self._next_write or state.iteration >= self.problem.config.iteration_limit

    def write(self, state: FitState, seconds: float) -> None:
        """Replace the file by the state, and the seconds of the fit so far."""
        start = time.perf_counter()
        buffer = io.BytesIO()
        fingerprint = _fingerprint(self.problem, _text(self.problem))
        torch.save({"version": _VERSION, "problem": fingerprint, "seconds": seconds, **_to_plain(state)}, buffer)
        content = buffer.getvalue()
        write_file(self.path, hashlib.sha256(content).digest() + content)
        end = time.perf_counter()
        self._next_write = end + _RUN_PER_WRITE * (end - start)

    def read(self) -> tuple[FitState, float]:
        """Return the file's state and seconds; refuse a damaged file, or a file of another problem."""
        data = self.path.read_bytes()
        digest, content = data[:_DIGEST_SIZE], data[_DIGEST_SIZE:]
        if hashlib.sha256(content).digest() != digest:
            raise ValueError(f"checkpoint {str(self.path)!r} is damaged, or no checkpoint of a fit")
        plain = torch.load(io.BytesIO(content), self.problem.device, weights_only=True)
        is_of_0_3 = "best_value" in plain
        if not is_of_0_3 and plain.get("version") != _VERSION:
            raise ValueError(f"checkpoint {str(self.path)!r} is of another version of kcgs: remove it, and fit anew")
        texts = problems_of_0_3(self.problem) if is_of_0_3 else [_text(self.problem)]
        if plain["problem"] not in [_fingerprint(self.problem, text) for text in texts]:
            raise ValueError(
                f"checkpoint {str(self.path)!r} belongs to another fit: image, regions, settings, num_gaussians and "
                "seed must be those it was written with"
            )
        if is_of_0_3:
            plain = from_0_3(plain, self.problem)
        return _from_plain(plain, self.problem), plain["seconds"]


def _text(problem: Problem) -> str:
    # a resumed fit may get more time
    settings = problem.config.model_dump_json(exclude={"max_seconds"})
    return f"{settings} {problem.num_gaussians} {problem.seed} {tuple(problem.target.shape)}"


def _fingerprint(problem: Problem, text: str) -> str:
    digest = hashlib.sha256(text.encode())
    digest.update(problem.target.cpu().numpy().tobytes())
    if problem.regions is not None:
        digest.update(repr(problem.regions.softness).encode())
        digest.update(problem.regions.labels.cpu().numpy().tobytes())
    return digest.hexdigest()


def _to_plain(state: FitState) -> dict[str, Any]:
    """Return tensors, numbers, strings, lists and dicts, which load without running code."""
    return {
        "numbers": _numbers(state),
        "cutoff": state.renderer.cutoff,
        "scene": _scene_to_plain(state.scene),
        "best": None if state.best is None else _best_to_plain(state.best),
        "anchor": None if state.anchor is None else state.anchor.state(),
        "optimizer": state.optimizer.state_dict(),
        "history": [tuple(entry) for entry in state.history],
        "contour_seconds": state.contour_seconds,
    }


def _numbers(state: FitState) -> dict[str, float]:
    """Return the numeric fields of a state, without its progress: the clock computes that again."""
    values = {field.name: getattr(state, field.name) for field in fields(state) if field.name != "progress"}
    return {name: value for name, value in values.items() if isinstance(value, int | float)}


def _from_plain(plain: dict[str, Any], problem: Problem) -> FitState:
    scene = _scene_from_plain(plain["scene"], problem.size)
    state = make_state(
        problem, scene.field, scene.regions,
        anchor=None if plain["anchor"] is None else RegionMap.from_state(plain["anchor"]),
        history=[HistoryEntry(*entry) for entry in plain["history"]],
        best=None if plain["best"] is None else _best_from_plain(plain["best"], problem.size),
        contour_seconds=plain["contour_seconds"],
        **plain["numbers"],
    )  # fmt: skip
    state.renderer = state.renderer._replace(cutoff=plain["cutoff"])
    state.optimizer.load_state_dict(plain["optimizer"])
    return state


def _scene_to_plain(scene: Scene) -> dict[str, Any]:
    field = scene.field
    tensors = [field.means.detach(), field.cholesky.detach(), field.colors.detach(), field.region_ids]
    return {"tensors": tensors, "regions": scene.get_extra_state()["regions"]}


def _scene_from_plain(plain: dict[str, Any], size: tuple[int, int]) -> Scene:
    scene = Scene(GaussianField(*plain["tensors"], size=size))
    scene.set_extra_state({"regions": plain["regions"], "metadata": None})
    return scene


def _best_to_plain(best: Best) -> dict[str, Any]:
    return {"scene": _scene_to_plain(best.scene), "numbers": [best.is_draft, best.value, best.psnr]}


def _best_from_plain(plain: dict[str, Any], size: tuple[int, int]) -> Best:
    scene = _scene_from_plain(plain["scene"], size)
    return Best(scene.field, [scene.regions], *(numbers.cpu() for numbers in plain["numbers"]))
