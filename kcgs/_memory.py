"""Checks, before the work begins, that images fit into memory."""

from __future__ import annotations

import math
import os
import re
from contextlib import suppress
from pathlib import Path

import torch
from torch import Tensor

# bytes that every machine is assumed to have free: only for more, the free memory is looked up
_SMALL = 1 << 26


def check_memory(name: str, size: tuple[int, int], per_pixel: float) -> None:
    """Raise ValueError if an image (height, width) of `per_pixel` bytes needs more memory than is free."""
    needed = float(size[0]) * size[1] * per_pixel
    if needed > _SMALL and needed > (free := free_memory()):
        memory = f"about {needed / 1e9:,.1f} GB of memory; {free / 1e9:,.1f} GB are free"
        raise ValueError(f"{name} asks for {size[1]} x {size[0]} pixels, which need {memory}")


def check_batch_memory(name: str, images: Tensor, per_image: float) -> None:
    """Raise ValueError if images of so many bytes each need more memory than is free; it says how many fit."""
    count, needed = len(images), len(images) * per_image
    if needed <= _SMALL:
        return
    free = free_memory()
    if images.is_cuda:  # memory that torch keeps for later is free, too
        kept = torch.cuda.memory_reserved(images.device) - torch.cuda.memory_allocated(images.device)
        free = float(torch.cuda.mem_get_info(images.device)[0] + kept)
    if needed > free:
        memory = f"{needed / 1e9:,.1f} GB of memory; {free / 1e9:,.1f} GB are free"
        raise ValueError(f"{name} has {count} images, which need about {memory}: at most {int(free / per_image)} fit")


def free_memory() -> float:
    """Return the bytes that are free, swap included, at most a container's limit; infinite where unknown."""
    limits = [math.inf]
    with suppress(OSError):
        facts = dict(re.findall(r"(\w+): +(\d+) kB", Path("/proc/meminfo").read_text()))
        limits.append(1024.0 * sum(int(facts.get(name, 0)) for name in ("MemAvailable", "SwapFree")))
    for file in ("memory.max", "memory/memory.limit_in_bytes"):
        with suppress(OSError, ValueError):
            limits.append(float(Path("/sys/fs/cgroup", file).read_text()))
    if limits == [math.inf]:
        with suppress(AttributeError, OSError, ValueError):
            limits.append(float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")))
    return min(limits)
