"""Jobs that the tests of the engines run; a module of its own, which worker processes can import by name."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import NamedTuple


class Task(NamedTuple):
    number: int
    folder: Path


def double(task: Task) -> tuple[int, int, int]:
    """Return a result, the process and its threads."""
    import torch

    return 2 * task.number, os.getpid(), torch.get_num_threads()


def fail_at_one(task: Task) -> int:
    if task.number == 1:
        raise ValueError("no 1")
    return task.number


def die_at_one(task: Task) -> int:
    """Kill the process of job 1."""
    if task.number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return task.number


def fit_zero(task: Task) -> tuple[int, bytes]:
    """Return the number of threads and the file of a fit, whose kernels run on all of them; job 1 fails."""
    fail_at_one(task)
    import torch

    from kcgs import fit, save

    ramp = torch.linspace(0.0, 1.0, 96)
    image = torch.stack([ramp.expand(64, 96), (8 * ramp).sin().square().expand(64, 96), ramp.flip(0).expand(64, 96)])
    labels = (ramp > 0.3).long().expand(64, 96).contiguous()
    path = task.folder / f"{os.getpid()}.safetensors"
    save(path, fit(image, labels, 40, iterations=10).scene)
    return torch.get_num_threads(), path.read_bytes()
