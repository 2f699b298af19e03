"""A fit on a device: the host runs ahead, and learns later what the device did. Most tests run that form on the CPU."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from kcgs import FitConfig, fit
from kcgs.fitting import FitResult, fit_problem
from kcgs.fitting.events import contours
from kcgs.fitting.measurement import Errors, measure_errors
from kcgs.fitting.problem import make_problem
from kcgs.fitting.state import FitState
from kcgs.fitting.stepper import EagerStepper
from kcgs.fitting.stepper_cuda import CudaStepper, Readback, StepGraph
from kcgs.functional import PairSoftness, contour_windows
from kcgs.kernels.cuda.capacity import reports
from kcgs.optim import adam
from kcgs.optim.gaussians import Gaussians, Renderer

from .absent_device import AbsentDevice, DeviceTensor

ITERATIONS = 200
Stepping = Callable[[FitState], Any]


def image() -> Tensor:
    y, x = torch.meshgrid(torch.arange(32.0), torch.arange(40.0), indexing="ij")
    return torch.stack([(0.3 * x).sin(), (0.2 * y).cos(), (0.1 * x * y).sin()]).mul(0.4).add(0.5)


def run(
    stepper_of: Stepping = CudaStepper, on_step: Any = None, images: Tensor | None = None, **settings: Any
) -> FitResult:
    """Fit 60 Gaussians with a stepper, to one image or to a batch."""
    config, images = FitConfig(**{"iterations": ITERATIONS, **settings}), image() if images is None else images
    return fit_problem(make_problem(images, None, 60, config, 0), on_step, stepper_of=stepper_of)


def same(a: FitResult, b: FitResult) -> bool:
    entries = [[entry._replace(seconds=0.0, ef_psnr=0.0) for entry in result.history] for result in (a, b)]
    pairs = zip(a.scene.field.parameters(), b.scene.field.parameters(), strict=True)
    return entries[0] == entries[1] and all(torch.equal(x, y) for x, y in pairs)


@pytest.fixture
def adam_of_a_device(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """Take GaussianAdam's form for devices: it leaves out gradients of NaN."""
    monkeypatch.setattr(adam, "_checks_gradients", lambda parameter: False)
    monkeypatch.setattr(adam, "_is_compiled", lambda *tensors: False)
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


@pytest.mark.parametrize(("objective", "has_maps"), [("l1", True), ("l2", False)])
def test_the_errors_of_a_batch_are_those_of_each_image(objective: str, has_maps: bool) -> None:
    """On a CPU bit for bit; on a device up to the order of sums, and without a wait."""
    images = torch.stack([image(), image().flip(1), image().flip(2)])
    renders = images + 0.4 * torch.randn(images.shape, generator=torch.Generator().manual_seed(0))
    labels = torch.stack([(torch.arange(40) > x).long().expand(32, 40) for x in (5, 20, 50)]) if has_maps else None
    config = FitConfig(objective=objective)
    maps = [None] * 3 if labels is None else list(labels)
    problems = [make_problem(one, own, 10, config, 0) for one, own in zip(images, maps, strict=True)]
    parts = [measure_errors(problem, render[None]) for problem, render in zip(problems, renders, strict=True)]
    expected = Errors(*(torch.cat(columns) for columns in zip(*parts, strict=True)))
    actual = measure_errors(make_problem(images, labels, 10, config, 0), renders)
    torch.testing.assert_close(actual, expected, rtol=0, atol=0, equal_nan=True)
    device = AbsentDevice()
    with device.use():
        problem = make_problem(DeviceTensor(images), labels, 10, config, 0)
        measure_errors(problem, DeviceTensor(renders))
        before = device.num_operations, device.num_waits
        errors = measure_errors(problem, DeviceTensor(renders))
    assert device.num_waits == before[1] and device.num_operations < before[0] + 20
    for column, values in zip(errors, expected, strict=True):
        torch.testing.assert_close(column.content, values, check_dtype=False, equal_nan=True)


def test_steps_that_are_not_waited_for_are_those_that_are() -> None:
    images = torch.stack([image(), image().flip(2).square()])
    waiting = run(EagerStepper, images=images)
    for stepper_of in (CudaStepper, lambda state: CudaStepper(state, IdleDevice)):
        assert same(waiting, run(stepper_of, images=images))


def test_a_late_history_is_the_history() -> None:
    """What has not arrived changes nothing but what a callback sees, and that by fewer than 20 iterations."""
    at_once, num_late = run(), 0
    measured = [entry.iteration for entry in at_once.history]

    def on_step(iteration: int, entry: Any) -> None:
        nonlocal num_late
        num_late += entry.iteration < max(i for i in measured if i < iteration)
        assert entry.iteration >= max(i for i in measured if i <= max(0, iteration - 21))

    assert same(at_once, run(lambda state: CudaStepper(state, IdleDevice), on_step)) and num_late > 30


def test_nothing_moves_where_a_step_had_no_room(adam_of_a_device: pytest.MonkeyPatch) -> None:
    """Its gradients and its render are NaN; the history lacks it, and the next steps get more room."""
    gradients, render, calls, waits = Renderer.squared_error_gradients, Renderer.render, [], []

    def has_room() -> bool:
        waits.append(reports())
        return reports() or len(waits) % 3 > 0

    def missed_gradients(renderer: Renderer, gaussians: Gaussians, target: Tensor) -> Gaussians:
        calls.append(1)
        values, factor = gradients(renderer, gaussians, target), 1.0 if has_room() else math.nan
        return values.map(lambda value: value * factor)

    def missed_render(renderer: Renderer, gaussians: Gaussians) -> Tensor:
        return render(renderer, gaussians) * (1.0 if has_room() else math.nan)

    whole = run()
    adam_of_a_device.setattr(Renderer, "squared_error_gradients", missed_gradients)
    adam_of_a_device.setattr(Renderer, "render", missed_render)
    result = run()
    assert len(waits) > ITERATIONS and waits.count(False) > ITERATIONS / 3
    assert len(whole.history) / 2 < len(result.history) < len(whole.history)
    assert all(math.isfinite(entry.psnr) for entry in result.history)
    assert all(parameter.isfinite().all() for parameter in result.scene.field.parameters())
    assert max(e.psnr for e in result.history) > max(e.psnr for e in whole.history) - 1.5


class RecordedGraph(StepGraph):
    """A graph that calls its step again."""

    def __init__(self) -> None:
        super().__init__()
        self.num_captures = self.num_replays = 0

    def record(self, move: Callable[[], None], device: torch.device) -> Any:
        def replay() -> None:
            self.num_replays += 1
            move()

        self.num_captures += 1
        return SimpleNamespace(replay=replay)


class ReplayingStepper(CudaStepper):
    """A stepper that replays steps on the CPU, too."""

    def _can_replay(self) -> bool:
        return self._runs_ahead()


@pytest.mark.usefixtures("adam_of_a_device")  # learning rates in float32
def test_captured_steps_are_those_that_are_not() -> None:
    """Between events there is one capture, except before the first event that follows the checked iterations."""
    graph = RecordedGraph()
    assert same(run(), run(lambda state: ReplayingStepper(state, graph=graph)))
    assert 3 < graph.num_captures < graph.num_replays / 4 and graph.num_replays > ITERATIONS / 3


def test_divergence_ends_the_fit_within_20_iterations(adam_of_a_device: pytest.MonkeyPatch) -> None:
    with pytest.warns(UserWarning, match="the fit diverged at iteration [12]0: the best so far is kept"):
        result = run(learning_rate_factor=1e33)
    assert result.stop_reason == "diverged"
    assert all(parameter.isfinite().all() for parameter in result.scene.field.parameters())


class Counter(TorchDispatchMode):
    """Counts operations, and calls of some functions."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0
        self.is_paused = False

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.count += not (self.is_paused or str(function).startswith("profiler."))
        return function(*args, **(kwargs or {}))

    def counted(self, function: Callable[..., Any], *, pauses: bool = False) -> Callable[..., Any]:
        """Count the calls of a function; if it pauses, nothing that it does."""

        def call(*arguments: Any, **settings: Any) -> Any:
            self.count += not self.is_paused
            before, self.is_paused = self.is_paused, self.is_paused or pauses
            try:
                return function(*arguments, **settings)
            finally:
                self.is_paused = before

        return call


def test_a_step_reads_no_value_and_takes_few_operations(adam_of_a_device: pytest.MonkeyPatch) -> None:
    """Besides the kernel's: see its own test."""
    counter, counts = Counter(), []

    class CountedStepper(CudaStepper):
        def step(self, rate: float) -> None:
            counter.count = 0
            # a render that was measured is differentiated by itself
            is_counted = self._runs_ahead() and self._rendered is None
            with counter:
                super().step(rate)
            if is_counted:
                counts.append(counter.count)

    gradients = counter.counted(Renderer.squared_error_gradients, pauses=True)
    adam_of_a_device.setattr(Renderer, "squared_error_gradients", gradients)
    adam_of_a_device.setattr(adam, "takes_triton", lambda *tensors: True)
    adam_of_a_device.setattr(adam, "_launch", counter.counted(lambda *arguments: None))
    for name in ("cpu", "numpy", "tolist"):
        adam_of_a_device.setattr(Tensor, name, counter.counted(getattr(Tensor, name)))
    run(CountedStepper)
    assert len(counts) > 60 and set(counts) == {2}


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
    monkeypatch.setattr(contour_windows, "check_image_and_labels", lambda image, labels: (image.double(), labels.cpu()))
    labels = (torch.arange(40) > 17).long().expand(32, 40).clone()
    labels[20:, 25:] = 5
    painted = (image() + 0.3 * (labels == 1) - 0.2 * (labels == 5)).clamp(0.0, 1.0)
    with device.use():
        result = fit(DeviceTensor(painted), labels, 60, recipe=FitConfig(iterations=30))
    assert isinstance(result.scene.regions.softness, PairSoftness)
    assert len(counts) > 5 and len(maps) > 2
    assert max(operations for operations, _ in counts) < 165 and max(waits for _, waits in counts) < 25
    assert not device.unordered


@pytest.mark.skipif(not torch.cuda.is_available(), reason="it takes a GPU")
@pytest.mark.parametrize("has_regions", [False, True])
def test_no_step_waits_for_a_gpu(has_regions: bool) -> None:
    """By torch's check of synchronisations, in all that a step does without an event."""
    num_checked = 0

    class CheckedStepper(CudaStepper):
        def check(self, name: str, *arguments: Any) -> Any:
            nonlocal num_checked
            # the first steps compile, and find the pixels near contours
            is_checked = self._runs_ahead() and self._state.iteration > ITERATIONS // 2
            num_checked += is_checked
            torch.cuda.set_sync_debug_mode("error" if is_checked else "default")
            try:
                return getattr(super(), name)(*arguments)
            finally:
                torch.cuda.set_sync_debug_mode("default")

        def step(self, rate: float) -> None:
            self.check("step", rate)

        def measure(self, seconds: float) -> None:
            self.check("measure", seconds)

        def overflowing_images(self) -> list[int]:
            return self.check("overflowing_images")

    class NeverReplaying(CudaStepper):
        def _can_replay(self) -> bool:
            return False

    labels = (torch.arange(40) > 17).long().expand(32, 40) if has_regions else None
    config = FitConfig(iterations=ITERATIONS)

    def run_on(device: str, stepper_of: Stepping) -> FitResult:
        return fit_problem(make_problem(image().to(device), labels, 60, config, 0), stepper_of=stepper_of)

    results = [run_on("cuda", stepper_of) for stepper_of in (CheckedStepper, CheckedStepper, NeverReplaying)]
    assert num_checked > ITERATIONS / 2
    for result in results[1:]:
        assert all(
            torch.equal(*pair) for pair in zip(results[0].scene.parameters(), result.scene.parameters(), strict=True)
        )
    on_cpu = run_on("cpu", EagerStepper)
    assert max(e.psnr for e in results[0].history) > max(e.psnr for e in on_cpu.history) - 0.5
