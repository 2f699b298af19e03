"""A fit on a device: the host runs ahead, and learns later what the device did. Most tests run that form on the CPU."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from kcgs import FitConfig, fit
from kcgs.fitting import FitResult, captured, divergence, report, state
from kcgs.fitting.events import Densify, EndDrafts, contours, log
from kcgs.fitting.problem import make_problem
from kcgs.fitting.readback import Readback
from kcgs.fitting.state import FitState
from kcgs.functional import PairSoftness, contour_fit
from kcgs.kernels.cuda.capacity import reports
from kcgs.optim import gaussian_adam
from kcgs.optim.descent import FieldDescent
from kcgs.optim.gaussians import Renderer

from .absent_device import AbsentDevice, DeviceTensor

ITERATIONS = 240


def image() -> Tensor:
    y, x = torch.meshgrid(torch.arange(32.0), torch.arange(40.0), indexing="ij")
    return torch.stack([(0.3 * x).sin(), (0.2 * y).cos(), (0.1 * x * y).sin()]).mul(0.4).add(0.5)


def run(count: int = 60, **settings: Any) -> FitResult:
    on_step = settings.pop("on_step", None)
    recipe = FitConfig(**{"iterations": ITERATIONS, **settings})
    return fit(image(), None, count, recipe=recipe, on_step=on_step)


def same(a: FitResult, b: FitResult) -> bool:
    entries = [[entry._replace(seconds=0.0, ef_psnr=0.0) for entry in result.history] for result in (a, b)]
    pairs = zip(a.scene.field.parameters(), b.scene.field.parameters(), strict=True)
    return entries[0] == entries[1] and all(torch.equal(x, y) for x, y in pairs)


@pytest.fixture
def ahead(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """Take the form of a device, on the CPU."""
    monkeypatch.setattr(FitState, "runs_ahead", True)
    monkeypatch.setattr(log, "_errors_on_cpu", log._errors_on_device)
    monkeypatch.setattr(gaussian_adam, "_raises", lambda parameter: False)
    monkeypatch.setattr(gaussian_adam, "_is_compiled", lambda *tensors: False)
    return monkeypatch


class IdleDevice(Readback):
    """Numbers of a device that works only while the host waits for it, in the order of its tasks."""

    num_tasks = num_done = 0

    def __init__(self, numbers: Tensor) -> None:
        super().__init__(numbers)
        IdleDevice.num_tasks += 1
        self._task = IdleDevice.num_tasks

    def has_arrived(self) -> bool:
        return self._task <= IdleDevice.num_done

    def numbers(self) -> list[float]:
        IdleDevice.num_done = max(IdleDevice.num_done, self._task)
        return super().numbers()


def test_the_errors_of_a_render_are_those_of_the_cpu() -> None:
    labels = (torch.arange(40) > 17).long().expand(32, 40)
    for loss in ("l1", "l2"):
        problem = make_problem(image(), labels, 10, FitConfig(loss=loss), 0)
        render = image() + 0.4 * torch.randn(3, 32, 40, generator=torch.Generator().manual_seed(0))
        expected = log._errors_on_cpu(problem, render)
        torch.testing.assert_close(log._errors_on_device(problem, render), expected, check_dtype=False)


def test_a_late_log_is_the_log(ahead: pytest.MonkeyPatch) -> None:
    """What has not arrived changes nothing but what a callback sees, and that by fewer than 20 iterations."""
    at_once, num_late = run(), 0
    ahead.setattr(log, "Readback", IdleDevice)
    ahead.setattr(divergence, "Readback", IdleDevice)
    logged = [entry.iteration for entry in at_once.history]

    def on_step(iteration: int, entry: Any) -> None:
        nonlocal num_late
        num_late += entry.iteration < max(i for i in logged if i < iteration)
        assert entry.iteration >= max(i for i in logged if i <= max(0, iteration - 21))

    assert same(at_once, run(on_step=on_step)) and num_late > 50


def test_nothing_moves_where_a_step_had_no_room(ahead: pytest.MonkeyPatch) -> None:
    """Its gradients and its render are NaN; the history lacks it, and the next steps get more room."""
    gradients, render, calls, settled = Renderer.squared_error_gradients, FitState.render, [], []

    def missed(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **settings: Any) -> Any:
            calls.append(1)
            values = function(*arguments, **settings)
            if reports() or len(calls) % 3:  # it waits, or there is room
                return values
            return values * math.nan if isinstance(values, Tensor) else values.map(lambda value: value * math.nan)

        return call

    ahead.setattr(state, "settle", lambda device, size: settled.append(size))
    whole, num_events = run(), len(settled)
    ahead.setattr(Renderer, "squared_error_gradients", missed(gradients))
    ahead.setattr(FitState, "render", missed(render))
    result = run()
    num_misses = len(settled) - 2 * num_events
    assert len(calls) > ITERATIONS and 3 < num_misses < ITERATIONS / 20 and set(settled) == {(32, 40)}
    assert len(whole.history) / 2 < len(result.history) < len(whole.history)
    assert all(math.isfinite(entry.psnr) for entry in result.history)
    assert all(parameter.isfinite().all() for parameter in result.scene.field.parameters())
    assert max(e.psnr for e in result.history) > max(e.psnr for e in whole.history) - 1.5


def test_captured_steps_are_those_that_are_not(ahead: pytest.MonkeyPatch) -> None:
    """Between events there is one capture, except before the first event that follows the checked iterations."""
    expected, captures, replays = run(), [], []

    def record(step: Callable[[], None], previous: Any, device: torch.device) -> SimpleNamespace:
        captures.append(step)
        return SimpleNamespace(replay=lambda: replays.append(step()))

    ahead.setattr(FitState, "replays", FitState.is_settled)
    ahead.setattr(captured, "_record", record)
    assert same(expected, run())
    assert 3 < len(captures) < len(replays) / 4 and len(replays) > ITERATIONS / 3


def test_divergence_ends_the_fit_within_20_iterations(ahead: pytest.MonkeyPatch) -> None:
    with pytest.warns(UserWarning, match="the fit diverged at iteration [12]0: the best so far is kept"):
        result = run(learning_rate_factor=1e33)
    assert result.stop_reason == "diverged"
    assert all(parameter.isfinite().all() for parameter in result.scene.field.parameters())


class Counter(TorchDispatchMode):
    """Count operations, and reads of values, outside of what is paused."""

    def __init__(self) -> None:
        super().__init__()
        self.operations: list[str] = []
        self.reads: list[str] = []
        self.is_paused = False

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if not self.is_paused and not str(function).startswith("profiler."):
            self.operations.append(str(function))
        return function(*args, **(kwargs or {}))

    @contextmanager
    def pause(self) -> Iterator[None]:
        before, self.is_paused = self.is_paused, True
        try:
            yield
        finally:
            self.is_paused = before

    def paused(self, function: Callable[..., Any], name: str = "") -> Callable[..., Any]:
        @functools.wraps(function)
        def call(*arguments: Any, **settings: Any) -> Any:
            if name and not self.is_paused:
                self.operations.append(name)
            with self.pause():
                return function(*arguments, **settings)

        return call

    def reading(self, function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def call(*arguments: Any, **settings: Any) -> Any:
            if not self.is_paused:
                self.reads.append(function.__name__)
            return function(*arguments, **settings)

        return call


READS = ["item", "tolist", "numpy", "cpu", "__bool__", "__float__", "__int__", "__index__", "nonzero"]


def test_a_step_reads_no_value_and_takes_few_operations(ahead: pytest.MonkeyPatch) -> None:
    """Besides the kernel's: see its own test. A render that is checked belongs to a log or to an event."""
    counter, steps, checked = Counter(), [], set()
    for owner, name in ((Renderer, "squared_error_gradients"), (gaussian_adam, "_launch")):
        ahead.setattr(owner, name, counter.paused(getattr(owner, name), name))
    ahead.setattr(gaussian_adam, "takes_triton", lambda *tensors: True)
    ahead.setattr(gaussian_adam, "_launch", lambda *arguments: counter.operations.append("_launch"))
    for owner, name in ((Readback, "numbers"), (Densify, "act"), (EndDrafts, "act"), (torch.autograd, "grad")):
        ahead.setattr(owner, name, counter.paused(getattr(owner, name)))
    render = counter.paused(FitState.render)
    ahead.setattr(FitState, "render", lambda state: checked.add(state.iteration) or render(state))
    for name in READS:
        ahead.setattr(Tensor, name, counter.reading(getattr(Tensor, name)))

    def on_step(iteration: int, entry: Any) -> None:
        steps.append((iteration - 1, [*counter.operations], [*counter.reads]))
        counter.operations.clear()
        counter.reads.clear()

    with counter:
        run(on_step=on_step, iterations=300)
    for _, operations, reads in steps[1:]:  # the first has the band, once
        assert not reads and "aten._local_scalar_dense.default" not in operations, (reads, operations)
    counts = [len(operations) for iteration, operations, _ in steps if iteration not in checked]
    assert len(counts) > 150 and min(counts) == 2 and max(counts) <= 6
    assert max(len(operations) for _, operations, _ in steps[1:]) <= 25


def test_contours_move_on_a_device_with_few_waits_and_sums_of_one_order(monkeypatch: pytest.MonkeyPatch) -> None:
    """No operation mixes devices, either."""
    device, move, counts, maps = AbsentDevice(), contours.move_contours, [], set()

    def move_contours(*arguments: Any) -> Any:
        before = device.num_operations, device.num_waits
        regions = move(*arguments)
        counts.append((device.num_operations - before[0], device.num_waits - before[1]))
        maps.add(regions)
        return regions

    monkeypatch.setattr(contours, "move_contours", move_contours)
    # the windows of widths are summed on a GPU
    monkeypatch.setattr(contour_fit, "check_problem", lambda image, labels: (image.double(), labels.cpu()))
    labels = (torch.arange(40) > 17).long().expand(32, 40).clone()
    labels[20:, 25:] = 5
    painted = (image() + 0.3 * (labels == 1) - 0.2 * (labels == 5)).clamp(0.0, 1.0)
    with device.use():
        result = fit(DeviceTensor(painted), labels, 60, recipe=FitConfig(iterations=60))
    assert isinstance(result.scene.regions.softness, PairSoftness)
    assert len(counts) > 5 and len(maps) > 2
    assert max(operations for operations, _ in counts) < 150 and max(waits for _, waits in counts) < 25
    assert not device.unordered


@pytest.mark.skipif(not torch.cuda.is_available(), reason="it takes a GPU")
@pytest.mark.parametrize("has_regions", [False, True])
def test_no_step_waits_for_a_gpu(monkeypatch: pytest.MonkeyPatch, has_regions: bool) -> None:
    """By torch's check of synchronisations, in all that a step does without an event."""
    calls = []

    def without_waits(owner: Any, name: str, is_always: bool) -> None:
        function = getattr(owner, name)

        @functools.wraps(function)
        def call(*arguments: Any, **settings: Any) -> Any:
            calls.append(name)
            # the first step compiles, and finds the pixels near contours
            is_checked = calls.count("step") > 1 and (is_always or not reports())
            torch.cuda.set_sync_debug_mode("error" if is_checked else "default")
            try:
                return function(*arguments, **settings)
            finally:
                torch.cuda.set_sync_debug_mode("default")

        monkeypatch.setattr(owner, name, call)

    without_waits(divergence.StopAtDivergence, "act", True)
    without_waits(report, "collect_measurements", True)
    without_waits(gaussian_adam.GaussianAdam, "step", True)
    without_waits(log, "measure", False)
    without_waits(captured.CapturedStep, "__call__", True)
    without_waits(FitState, "render", False)
    without_waits(FieldDescent, "move", False)
    labels = (torch.arange(40) > 17).long().expand(32, 40) if has_regions else None
    results = [fit(image().cuda(), labels, 60, recipe=FitConfig(iterations=ITERATIONS)) for _ in range(2)]
    assert calls.count("__call__") > ITERATIONS and calls.count("step") >= ITERATIONS / 2
    assert all(torch.equal(*pair) for pair in zip(*(r.scene.field.parameters() for r in results), strict=True))
    monkeypatch.setattr(FitState, "replays", False)
    eager = fit(image().cuda(), labels, 60, recipe=FitConfig(iterations=ITERATIONS))
    assert all(torch.equal(*pair) for pair in zip(results[0].scene.parameters(), eager.scene.parameters(), strict=True))
    on_cpu = fit(image(), labels, 60, recipe=FitConfig(iterations=ITERATIONS))
    assert max(e.psnr for e in results[0].history) > max(e.psnr for e in on_cpu.history) - 0.5
