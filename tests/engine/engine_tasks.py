"""Jobs that the tests of the engines run; a module of its own, which worker processes can import by name."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import NamedTuple

import torch


class Task(NamedTuple):
    number: int
    folder: Path


def double(task: Task) -> tuple[int, int, int]:
    """Return a result, the process and its threads."""
    return 2 * task.number, os.getpid(), torch.get_num_threads()


def fail_at_one(task: Task) -> int:
    if task.number == 1:
        raise ValueError("no 1")
    return task.number


def die_at_one(task: Task) -> int:
    """Write down that the job is done; the job 1 kills its process, the first time."""
    mark = task.folder / str(task.number)
    first = not mark.exists()
    mark.touch()
    if task.number == 1 and first:
        os.kill(os.getpid(), signal.SIGKILL)
    return task.number


def fitted_bytes(task: Task) -> bytes:
    """Fit a small picture; a kernel that runs on several threads, and recipes that draw at random, must agree."""
    from kcgs import FitConfig, fit, save

    ramp = torch.linspace(0.0, 1.0, 96)
    image = torch.stack([ramp.expand(64, 96), (8 * ramp).sin().square().expand(64, 96), ramp.flip(0).expand(64, 96)])
    labels = (ramp > 0.3 + 0.1 * task.number).long().expand(64, 96).contiguous()
    result = fit(image, labels, 40, recipe=FitConfig.from_recipe("best", iterations=10), seed=task.number)
    path = task.folder / f"{os.getpid()}-{task.number}.safetensors"
    save(path, result.scene)
    return path.read_bytes()
