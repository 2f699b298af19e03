"""Steps of a fit on a GPU, which the host does not wait for."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from operator import is_not
from typing import Any

import torch
from torch import Tensor

from kcgs.kernels import settle, without_waiting
from kcgs.optim import FieldState, move_field, set_rates

from .measurement import Errors, Measurement, measure_errors, record, snapshot
from .state import LARGEST, FitState

# first iterations of a fit, in which the host waits: Gaussians may grow faster than the room for their lists
_CHECKED_ITERATIONS = 20
# iterations between two checks of divergence: the host is at most twice as many iterations ahead of the device
_ITERATIONS_PER_CHECK = 10


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


class CudaStepper:
    """Steps in which the host runs ahead of a GPU; between events they are replayed as a CUDA graph.

    A step that finds no room on the device has gradients and a render of NaN. GaussianAdam skips these gradients, the
    history skips the render. The host waits for the first steps, for the step after an event, and for the step after
    it has learned of missing room, to learn how much room the lists need.

    Args:
        state: of a fit by GaussianAdam.
        read_back: starts the copy of a tensor to the host.
        graph: replays a step.
    """

    def __init__(
        self, state: FitState, read_back: Callable[[Tensor], Readback] = Readback, graph: StepGraph | None = None
    ) -> None:
        self._state, self._read_back, self._graph = state, read_back, graph or StepGraph()
        self._first_iteration = state.iteration
        self._last_content: list[object] = []
        self._lacks_room = False
        self._rendered: Tensor | None = None
        self._pending: deque[tuple[Measurement, Readback]] = deque()
        self._magnitudes: Readback | None = None

    def step(self, rate: float) -> None:
        """See :class:`Stepper`."""
        state, rendered = self._state, self._rendered
        self._rendered = None
        if self._must_wait():
            self._make_room()
            self._graph.forget()
        set_rates(state, rate)
        with self._running_ahead():
            if self._can_replay():
                self._graph.step(state)
            else:
                move_field(state, rendered)
        state.iteration += 1
        self._last_content, self._lacks_room = self._content(), False

    def measure(self, seconds: float) -> None:
        """See :class:`Stepper`; the host waits for the first measurement of a fit."""
        state = self._state
        with self._running_ahead():
            self._rendered = state.render()
            errors = self._read_back(torch.stack(measure_errors(state.problem, self._rendered)))
        # copy the scene now: whether it is the best is known only when the errors arrive
        self._pending.append((snapshot(state, seconds), errors))
        self.poll(wait=not state.history)

    def poll(self, *, wait: bool = False) -> None:
        """See :class:`Stepper`."""
        while self._pending and (wait or self._pending[0][1].has_arrived()):
            measurement, errors = self._pending.popleft()
            record(self._state, measurement, Errors(*errors.numbers()))
        if wait:
            self._make_room()

    def overflowing_images(self) -> list[int]:
        """See :class:`Stepper`; up to 20 iterations late.

        Every ten iterations the host waits for the numbers of ten iterations before. They also tell whether a step
        found no room.
        """
        if self._state.iteration % _ITERATIONS_PER_CHECK:
            return []
        field = self._state.field
        tables = [field.means, field.cholesky, field.colors]
        gradients = [table.grad for table in tables if table.grad is not None]
        previous, self._magnitudes = self._magnitudes, self._read_back(_magnitudes([*tables, *gradients]))
        if previous is None:
            return []
        numbers, columns = previous.numbers(), sum(table.shape[-1] for table in tables)
        self._lacks_room |= bool(numbers[:, columns:].isnan().any())
        is_within = (numbers[:, :columns] < LARGEST).all(1)
        return (~is_within).nonzero()[:, 0].tolist()

    def _make_room(self) -> None:
        """Wait for the device, and make room for lists that did not fit."""
        problem = self._state.problem
        settle(problem.device, problem.num_images, problem.size)

    def _content(self) -> list[object]:
        """Return the objects that a step uses and that events replace."""
        field = self._state.field
        return [field.means, field.cholesky, field.colors, field.region_ids, self._state.renderer]

    def _must_wait(self) -> bool:
        """Whether the host must wait for the device before the next step."""
        content, last = self._content(), self._last_content
        return self._lacks_room or len(content) != len(last) or any(map(is_not, content, last))

    def _runs_ahead(self) -> bool:
        """Whether a render may go without waiting for the device."""
        return not self._must_wait() and self._state.iteration >= self._first_iteration + _CHECKED_ITERATIONS

    @contextmanager
    def _running_ahead(self) -> Iterator[None]:
        """Render without waiting where possible, and without an autograd graph if the step needs none."""
        with without_waiting() if self._runs_ahead() else nullcontext(), torch.set_grad_enabled(not self._can_replay()):
            yield

    def _can_replay(self) -> bool:
        """Whether a CUDA graph can replay the next step: fused kernels compute its gradients on a GPU."""
        state = self._state
        return self._runs_ahead() and state.field.means.is_cuda and state.objective.has_fused_gradients(state.renderer)


@torch.no_grad()
def _magnitudes(tables: list[Tensor]) -> Tensor:
    """Return the largest magnitude in each column of the tables, (B, K), for each image; NaN counts as largest."""
    return torch.cat(tables, -1).abs().amax(1)
