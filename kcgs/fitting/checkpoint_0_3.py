"""Checkpoints of version 0.3, as this version stores them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import torch
from pydantic_core import to_json
from torch import Tensor

from .measurement import decibel
from .problem import Problem

# `objective` and `loss` in version 0.3, for each objective
_OBJECTIVES: dict[str | None, list[tuple[str, str]]] = {
    None: [("auto", "l2")],
    "l2": [("psnr", "l2"), ("auto", "l2")],
    "l1": [("psnr", "l1"), ("auto", "l1")],
    "ms-ssim": [("ms-ssim", "l2")],
}
_NUMBERS = ("iteration", "num_initial", "num_requested", "num_additions", "num_late_moves")


def problems_of_0_3(problem: Problem) -> Iterator[str]:
    """Yield the text of a problem for its fingerprint in version 0.3, once for each name of its objective."""
    settings = problem.config.model_dump(exclude={"max_seconds", "bounded"})
    for objective, loss in _OBJECTIVES[settings["objective"]]:
        old: dict[str, Any] = {}  # in the order of 0.3
        for name, value in settings.items():
            if name == "densify_from":
                old["densify"] = "matching-pursuit"
            old |= {"objective": objective, "loss": loss} if name == "objective" else {name: value}
        yield f"8 {to_json(old).decode()} {problem.num_gaussians} {problem.seed} {tuple(problem.target.shape[1:])}"


def from_0_3(plain: dict[str, Any], problem: Problem) -> dict[str, Any]:
    """Return the content of a checkpoint of version 0.3 as this version's, with a batch of one image."""
    best, value = None, plain["best_value"]
    if plain["best"] is not None:
        psnr = float(decibel(torch.tensor(value, dtype=torch.float64)))
        if not problem.objective.is_ranked_by_psnr:
            psnr = min(plain["history"], key=lambda entry: entry[2])[3]
        # 0.3 set the value to infinity when the drafts ended
        is_draft = plain["cutoff"] != problem.config.cutoff or value == math.inf
        numbers = [torch.tensor([is_draft]), *(torch.tensor([x], dtype=torch.float64) for x in (value, psnr))]
        best = {"scene": _scene(plain["best"]), "numbers": numbers}
    return {
        **{name: plain[name] for name in ("cutoff", "anchor", "history", "seconds")},
        "numbers": {name: plain[name] for name in _NUMBERS},
        "scene": _scene(plain["scene"]),
        "best": best,
        "optimizer": _batched(plain["optimizer"]),
        "contour_seconds": [],
    }


def _scene(plain: dict[str, Any]) -> dict[str, Any]:
    return {"tensors": _batched(plain["tensors"]), "regions": plain["regions"]}


def _batched(content: Any) -> Any:
    """Give every tensor in nested dicts and lists a batch of one."""
    if isinstance(content, Tensor):
        return content[None]
    if isinstance(content, dict):
        return {name: _batched(value) for name, value in content.items()}
    return [_batched(value) for value in content] if isinstance(content, list) else content
