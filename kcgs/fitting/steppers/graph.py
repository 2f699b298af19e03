"""A step of a fit as a CUDA graph, whose replay takes the host little time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from kcgs.optim import FieldState, move_field


class StepGraph:
    """A gradient and a step of the optimizer, captured once and then replayed.

    A capture is valid until an event replaces a tensor of the fit or its cutoff. The first call takes its step without
    a capture, since programs cannot be compiled during one.
    """

    def __init__(self) -> None:
        self._graph: Any = None
        self._is_valid = False
        self._rates: list[Tensor] = []

    def forget(self) -> None:
        """Capture again at the next call."""
        self._is_valid = False

    def step(self, state: FieldState) -> None:
        """Take a step with the current learning rates."""
        device, groups, is_first = state.field.means.device, state.optimizer.param_groups, not self._rates
        if is_first:
            self._rates = [torch.empty((), device=device) for _ in groups]
        elif not self._is_valid:
            self._graph, self._is_valid = self.record(lambda: self._move(state), device), True
        for rate, group in zip(self._rates, groups, strict=True):
            rate.fill_(group["lr"])
        if is_first:
            self._move(state)
        else:
            self._graph.replay()

    def _move(self, state: FieldState) -> None:
        """Take a step that reads the learning rates from the tensors that a replay reads."""
        groups = state.optimizer.param_groups
        numbers = [group["lr"] for group in groups]
        for group, rate in zip(groups, self._rates, strict=True):
            group["lr"] = rate
        move_field(state)
        for group, number in zip(groups, numbers, strict=True):
            group["lr"] = number

    def record(self, move: Callable[[], None], device: torch.device) -> Any:
        """Capture a step in the memory of the previous graph; that graph is not replayed again."""
        with torch.cuda.device(device):
            graph, stream, current = torch.cuda.CUDAGraph(), torch.cuda.Stream(), torch.cuda.current_stream()
            stream.wait_stream(current)
            with torch.cuda.stream(stream):
                # thread_local: other threads may use the device during the capture
                graph.capture_begin(None if self._graph is None else self._graph.pool(), "thread_local")
                try:
                    move()
                finally:
                    graph.capture_end()
            current.wait_stream(stream)
        return graph
