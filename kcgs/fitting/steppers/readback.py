"""Copies of small tensors to the host while the device works on."""

from __future__ import annotations

import torch
from torch import Tensor


class Readback:
    """A small tensor on its way to the host, which does not wait; a tensor on the CPU has arrived at once."""

    def __init__(self, numbers: Tensor) -> None:
        # CUDA copies into pinned memory, after the work that the device has queued before
        self._numbers = numbers.detach().to("cpu", non_blocking=numbers.is_cuda)
        self._copied: torch.cuda.Event | None = None
        if numbers.is_cuda:
            with torch.cuda.device_of(numbers):
                self._copied = torch.cuda.Event()
                self._copied.record()

    def has_arrived(self) -> bool:
        """True once `numbers` returns without waiting."""
        return self._copied is None or self._copied.query()

    def numbers(self) -> Tensor:
        """Return the numbers in float64 on the host, and wait for them where they have not arrived."""
        if self._copied is not None:
            self._copied.synchronize()
        return self._numbers.double()
