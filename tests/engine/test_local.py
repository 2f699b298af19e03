"""Jobs in this process, and in worker processes of this machine."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import torch

from kcgs.engine import run_jobs


def function(name: str) -> Callable[[Any], Any]:
    return getattr(import_module("engine_tasks"), name)


def tasks(count: int, folder: Path) -> list[Any]:
    return [import_module("engine_tasks").Task(number, folder) for number in range(count)]


@pytest.mark.parametrize("workers", [None, 2])
class TestBoth:
    def test_results_and_threads(self, tmp_path: Path, workers: int | None) -> None:
        before = torch.get_num_threads()
        outcomes = dict(run_jobs(function("double"), tasks(4, tmp_path), workers=workers, threads=3))
        assert torch.get_num_threads() == before
        results, processes, threads = zip(*(outcomes[index] for index in range(4)), strict=True)
        assert results == (0, 2, 4, 6) and set(threads) == {3}
        # while one process starts, the other may do all
        assert len(set(processes)) <= (workers or 1) and (os.getpid() in processes) == (workers != 2)

    def test_a_job_that_raises_ends_the_iteration(self, tmp_path: Path, workers: int | None) -> None:
        with pytest.raises(ValueError, match="no 1"):
            list(run_jobs(function("fail_at_one"), tasks(2, tmp_path)[1:], workers=workers))

    def test_no_jobs(self, workers: int | None) -> None:
        assert list(run_jobs(function("double"), [], workers=workers)) == []


def test_one_thread_by_default(tmp_path: Path) -> None:
    assert list(run_jobs(function("double"), tasks(1, tmp_path))) == [(0, (0, os.getpid(), 1))]


def test_a_killed_worker_ends_the_iteration(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="a worker process was killed, perhaps because memory ran out"):
        list(run_jobs(function("die_at_one"), tasks(2, tmp_path)[1:], workers=2))


def test_workers_end_with_their_caller(tmp_path: Path) -> None:
    code = (
        "import os, signal, sys; sys.path.insert(0, sys.argv[1])\n"
        "from pathlib import Path\n"
        "from engine_tasks import Task, double\n"
        "from kcgs.engine import run_jobs\n"
        "if __name__ == '__main__':\n"
        "    jobs = run_jobs(double, [Task(0, Path())], workers=2)\n"
        "    print(next(jobs)[1][1], flush=True)\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    script = tmp_path / "script.py"
    script.write_text(code)
    command = [sys.executable, str(script), str(Path(__file__).parent)]
    # the worker has the standard output, too: it is read until it has ended
    caller = subprocess.run(command, capture_output=True, text=True, check=False)
    assert caller.returncode == -signal.SIGKILL and int(caller.stdout) > 0, caller.stderr


class TestArguments:
    def test_refused(self) -> None:
        with pytest.raises(ValueError, match="engine must be one of local, ray; got 'slurm'"):
            run_jobs(str, [], engine="slurm")
        with pytest.raises(ValueError, match="workers must be at least 1; got 0"):
            run_jobs(str, [], workers=0)
        with pytest.raises(ValueError, match="threads must be at least 1; got -1"):
            run_jobs(str, [], threads=-1)

    def test_without_ray(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "ray.util.multiprocessing", None)  # which other tests may have imported
        with pytest.raises(ImportError, match=r"pip install ray"):
            run_jobs(str, [], engine="ray")
