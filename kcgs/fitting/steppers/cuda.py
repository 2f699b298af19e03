"""Steps of a fit on a GPU, which the host does not wait for."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from operator import is_not

import torch
from torch import Tensor

from kcgs.fitting.measurement import Errors, Measurement, measure_errors, record, snapshot
from kcgs.fitting.state import LARGEST, FitState
from kcgs.kernels import settle, without_waiting
from kcgs.optim import move_field, set_rates

from .graph import StepGraph
from .readback import Readback

# first iterations of a fit, in which the host waits: Gaussians may grow faster than the room for their lists
_CHECKED_ITERATIONS = 20
# iterations between two checks of divergence: the host is at most twice as many iterations ahead of the device
_ITERATIONS_PER_CHECK = 10


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
