"""Jobs in this process, and in worker processes of this machine."""

from __future__ import annotations

import multiprocessing
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

from kcgs.engine import Done, run_jobs


def function(name: str) -> Callable[[Any], Any]:
    return getattr(import_module("engine_tasks"), name)


def tasks(count: int, folder: Path) -> list[Any]:
    return [import_module("engine_tasks").Task(number, folder) for number in range(count)]


def by_index(found: list[Done[Any]]) -> list[Done[Any]]:
    assert sorted(done.index for done in found) == list(range(len(found)))  # each job once
    return sorted(found, key=lambda done: done.index)


@pytest.mark.parametrize("workers", [None, 1, 2])
class TestBoth:
    def test_results_threads_and_a_job_that_raises(self, tmp_path: Path, workers: int | None) -> None:
        before = torch.get_num_threads()
        found = list(run_jobs(function("fail_at_one"), tasks(6, tmp_path), workers=workers, threads=3))
        assert torch.get_num_threads() == before
        found = by_index(found)
        results, processes, threads = zip(*(done.result for done in found if done.result), strict=True)
        assert results == (0, 4, 6, 8, 10) and set(threads) == {3}
        # while one process starts, the other may do all
        assert len(set(processes)) <= (workers or 1) and (os.getpid() in processes) == (workers != 2)
        assert [done.error is None for done in found] == [True, False, True, True, True, True]
        error = found[1].error
        assert error is not None and (error.type, error.message) == ("ValueError", "no 1\nplease")
        assert "fail_at_one" in error.traceback and str(error) == "ValueError: no 1 please"

    def test_no_jobs(self, workers: int | None) -> None:
        assert list(run_jobs(function("process_and_threads"), [], workers=workers)) == []


def test_one_thread_by_default(tmp_path: Path) -> None:
    (done,) = run_jobs(function("process_and_threads"), tasks(1, tmp_path))
    assert done.result == (os.getpid(), 1)


class TestProcesses:
    def test_killed(self, tmp_path: Path) -> None:
        """One job kills every worker, another its first one, a third has a result that cannot be sent."""
        found = by_index(list(run_jobs(function("misbehave"), tasks(5, tmp_path), workers=2)))
        assert [done.result for done in found] == [0, None, 4, None, 8]
        error = found[1].error
        assert error is not None and error.type == "WorkerDied"
        assert error.message == "the worker process was ended by SIGKILL, memory may have run out, twice"
        assert "lambda" in str(found[3].error)
        assert [(tmp_path / str(i)).read_text() for i in range(5)] == ["x", "xx", "xx", "x", "x"]

    def test_left_early(self, tmp_path: Path) -> None:
        iterator = run_jobs(function("first_alone_ends"), tasks(3, tmp_path), workers=2)
        assert next(iterator).index == 0
        iterator.close()  # type: ignore[attr-defined]
        assert not multiprocessing.active_children()

    def test_caller_killed(self, tmp_path: Path) -> None:
        code = (
            "import os, signal, sys; sys.path.insert(0, sys.argv[1])\n"
            "from pathlib import Path\n"
            "from engine_tasks import Task, process_and_threads\n"
            "from kcgs.engine import run_jobs\n"
            "if __name__ == '__main__':\n"
            "    tasks = [Task(i, Path()) for i in range(3)]\n"
            "    jobs = run_jobs(process_and_threads, tasks, workers=2)\n"
            "    print(next(jobs).result[0], flush=True)\n"
            "    os.kill(os.getpid(), signal.SIGKILL)\n"
        )
        script = tmp_path / "script.py"
        script.write_text(code)
        command = [sys.executable, str(script), str(Path(__file__).parent)]
        # the workers have the standard output, too: it is read until they have ended
        ended = subprocess.run(command, capture_output=True, text=True, check=False)
        assert ended.returncode == -signal.SIGKILL and int(ended.stdout) > 0, ended.stderr


class TestArguments:
    def test_refused(self) -> None:
        with pytest.raises(ValueError, match="engine must be one of local, ray; got 'slurm'"):
            run_jobs(str, [], engine="slurm")
        with pytest.raises(ValueError, match="workers must be at least 1; got 0"):
            run_jobs(str, [], workers=0)
        with pytest.raises(ValueError, match="threads must be at least 1; got -1"):
            run_jobs(str, [], threads=-1)

    def test_without_ray(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "ray", None)
        with pytest.raises(ImportError, match=r"pip install 'kcgs\[ray\]'"):
            run_jobs(str, [], engine="ray")
