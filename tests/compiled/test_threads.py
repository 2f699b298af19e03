"""Threads of torch and of the kernels while their short operations take turns."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from kcgs import GaussianField, Scene, load
from kcgs.compiled import num_threads, threads_for_kernels
from kcgs.compiled.program import Program
from kcgs.compiled.tasks import first_task, next_task, phases, run_tasks
from kcgs.rate import compress
from kcgs.segment import segment

SIZE = (24, 32)
LABELS = (torch.arange(32) >= 20).long().expand(SIZE)


@pytest.fixture
def three_threads() -> Iterator[None]:
    """Have torch take three threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


def scene() -> Scene:
    return Scene(GaussianField.random(30, SIZE, regions=LABELS, seed=0), LABELS)


@pytest.mark.usefixtures("three_threads")
class TestThreads:
    def test_kernels_have_all(self) -> None:
        with threads_for_kernels(24 * 32):
            with threads_for_kernels(24 * 32):
                assert (torch.get_num_threads(), num_threads()) == (1, 3)
            assert (torch.get_num_threads(), num_threads()) == (1, 3)
        assert torch.get_num_threads() == num_threads() == 3

    def test_torch_has_all_on_large_images(self) -> None:
        with threads_for_kernels(1 << 22):
            assert torch.get_num_threads() == num_threads() == 3

    @pytest.mark.parametrize(
        ("name", "work"),
        [
            ("kcgs.segment.cleanup.merge_small", lambda: segment(torch.rand(3, *SIZE), "felzenszwalb")),
            ("kcgs.rate.compress.psnr", lambda: compress(scene(), torch.rand(3, *SIZE), target_psnr=5.0)),
        ],
    )
    def test_short_operations(self, monkeypatch: pytest.MonkeyPatch, name: str, work: Callable[[], Any]) -> None:
        threads: list[tuple[int, int]] = []
        module, _, inner = name.rpartition(".")
        function = getattr(import_module(module), inner)

        def record(*arguments: Any, **settings: Any) -> Any:
            threads.append((torch.get_num_threads(), num_threads()))
            return function(*arguments, **settings)

        monkeypatch.setattr(import_module(module), inner, record)
        work()
        assert set(threads) == {(1, 3)} and torch.get_num_threads() == 3


_program = Program("tasks of a test")


@_program.entry
def fail_at(failing: int, done: Any, tasks: Any, counters: Any) -> None:
    k = first_task(tasks, counters)
    while k >= 0:
        if k == failing:
            raise ValueError("a task fails")
        done[k] = True
        k = next_task(tasks, counters, k)


@_program.entry
def count_too_early(done: Any, early: Any, tasks: Any, counters: Any) -> None:
    k = first_task(tasks, counters)
    while k >= 0:
        for other in range(tasks[k, 0]):
            early[k] += not done[other]
        done[k] = True
        k = next_task(tasks, counters, k)


@pytest.mark.usefixtures("three_threads")
class TestTasks:
    def test_waits_for_the_tasks_before(self) -> None:
        starts = np.random.default_rng(0).random(300) * np.arange(300)
        tasks = starts.astype(np.int64)[:, None]
        for work in (None, 1, 0):
            done, early = np.zeros(len(tasks), np.bool_), np.zeros(len(tasks), np.int64)
            run_tasks(partial(count_too_early, done, early), tasks, work)
            assert done.all() and not early.any()

    @pytest.mark.parametrize("failing", [0, 3])
    def test_failure_of_any_thread(self, failing: int) -> None:
        """The caller gets the exception, and no later phase begins."""
        tasks = phases(*(np.zeros((2, 1), np.int64) for _ in range(4)))
        for _ in range(5):
            done = np.zeros(len(tasks), np.bool_)
            with pytest.raises(ValueError, match="a task fails"):
                run_tasks(partial(fail_at, failing, done), tasks)
            assert not done[failing] and not done[2 * (failing // 2 + 1) :].any()
        done = np.zeros(len(tasks), np.bool_)
        run_tasks(partial(fail_at, -1, done), tasks)
        assert done.all()

    def test_failure_of_another_thread(self) -> None:
        """The caller, which finds no task left, gets the exception of the other thread."""
        tasks = phases(np.zeros((2, 1), np.int64))

        def wait_or_fail(tasks: Any, counters: Any) -> None:
            if threading.current_thread() is threading.main_thread():
                while not counters.any():
                    time.sleep(0.001)
            fail_at(0, np.zeros(2, np.bool_), tasks, counters)

        with pytest.raises(ValueError, match="a task fails"):
            run_tasks(wait_or_fail, tasks)


AT_EXIT = """
import atexit, sys, threading
import torch
from kcgs import GaussianField, Scene, fit

torch.set_num_threads(3)
labels = (torch.arange(64) >= 20).long().expand(48, 64)
scene = Scene(GaussianField.random(400, (48, 64), regions=labels, seed=0), labels)

def work():
    threading.main_thread().join()
    fit(torch.rand(3, 48, 64), labels, 40, iterations=3).scene.save(sys.argv[1])

atexit.register(lambda: print("at exit", tuple(scene.render().shape)))
threading.Thread(target=work).start()
"""


def test_work_outlives_the_main_thread(tmp_path: Path) -> None:
    path = tmp_path / "scene.safetensors"
    done = subprocess.run([sys.executable, "-c", AT_EXIT, str(path)], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert load(path).num_gaussians <= 40 and done.stdout == "at exit (3, 48, 64)\n"
