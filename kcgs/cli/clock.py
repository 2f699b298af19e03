"""The clock of `--max-seconds`: it counts all that a command does, from the start of its process."""

from __future__ import annotations

import math
import os
import sys
import time
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from torch import Tensor

_LOADED = time.perf_counter()
# in seconds per pixel of the metrics of a small image: those of a large one, which go by blocks of rows; and the end of
# a fit, with a file that is written, read and rendered
_BY_ROWS, _ENDING = 0.2, 0.1
# how much longer all that may take than foreseen, and what takes as long whatever the image
_MARGIN, _EXIT = 1.4, 0.3


class Clock(NamedTuple):
    """What was granted, and when it began to count."""

    seconds: float | None = None
    """None: no limit."""
    began: float = 0.0
    """Reading of `time.perf_counter`."""

    def took(self) -> float:
        """Return the seconds so far."""
        return time.perf_counter() - self.began

    def left(self, image: Tensor) -> float | None:
        """Return what may be used before the result is written and measured; None: no limit."""
        if self.seconds is None:
            return None
        pixels, metrics = image[0].numel(), _BY_ROWS if image[0].numel() > 1 << 20 else 1.0
        after = _EXIT + _MARGIN * (metrics + _ENDING) * pixels * _seconds_per_pixel()
        return max(self.seconds - self.took() - after, 1e-3)


def process_began() -> float:
    """Return the reading of `time.perf_counter` when this process began, where it is the command's own; or else now."""
    main = Path(getattr(sys.modules["__main__"], "__file__", None) or "")
    if main.stem != "kcgs" and main.parent != Path(__file__).parent:
        return time.perf_counter()
    try:
        ticks = int(Path("/proc/self/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[19])
        return time.perf_counter() - time.clock_gettime(time.CLOCK_BOOTTIME) + ticks / os.sysconf("SC_CLK_TCK")
    except (OSError, AttributeError):  # systems that do not say
        return _LOADED


@lru_cache(maxsize=1)
def _seconds_per_pixel() -> float:
    """Measure a small image twice, the first time to load what it takes."""
    import torch

    from kcgs.evaluate import measure

    image, seconds = torch.rand(3, 176, 176), math.inf
    for _ in range(2):
        start = time.perf_counter()
        measure(image, image, (image[0] > 0.5).long())
        seconds = time.perf_counter() - start
    return seconds / image[0].numel()
