"""The clock of `--max-seconds`: it counts all that a command does, from the start of its process."""

from __future__ import annotations

import os
import sys
import time
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from torch import Tensor

# what follows a fit, by the seconds per pixel of a small image's metrics: those of images above a megapixel, and its
# end with its file; how much longer that may take; and what takes as long for any image
_BY_ROWS, _ENDING, _MARGIN, _EXIT = 0.35, 0.15, 1.6, 0.5


class Clock(NamedTuple):
    """Seconds that were granted, None: no limit, and the reading of `time.perf_counter` when they began."""

    seconds: float | None = None
    began: float = 0.0

    def left(self, image: Tensor) -> float | None:
        """Return what may be used before the result is written and measured; None: no limit."""
        if self.seconds is None:
            return None
        pixels = image[0].numel()
        after = (_ENDING + (_BY_ROWS if pixels > 1 << 20 else 1.0)) * pixels * _seconds_per_pixel()
        return max(self.began + self.seconds - time.perf_counter() - _MARGIN * after - _EXIT, 1e-3)


def process_began() -> float:
    """Return the reading of `time.perf_counter` when this process began, where it is the command's own; else now."""
    now, main = time.perf_counter(), Path(getattr(sys.modules["__main__"], "__file__", None) or "")
    if main.stem != "kcgs" and main.parent != Path(__file__).parent:
        return now
    try:
        ticks = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
        return now - time.clock_gettime(time.CLOCK_BOOTTIME) + ticks / os.sysconf("SC_CLK_TCK")
    except (OSError, AttributeError):  # systems that do not say
        return now


@lru_cache(maxsize=1)
def _seconds_per_pixel() -> float:
    import torch

    from kcgs.evaluation import measure

    image = torch.rand(3, 176, 176)
    for _ in range(2):  # the first time loads what it takes
        start = time.perf_counter()
        measure(image, image, (image[0] > 0.5).long())
    return (time.perf_counter() - start) / image[0].numel()
