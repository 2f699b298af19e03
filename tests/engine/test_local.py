"""Jobs in this process, and in worker processes of this machine."""

from __future__ import annotations

import os
import subprocess
import sys
import time
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
    def test_results(self, tmp_path: Path, workers: int | None) -> None:
        seen: list[Done[int]] = []
        found = list(run_jobs(function("double"), tasks(5, tmp_path), workers=workers, on_done=seen.append))
        assert [done.result for done in by_index(found)] == [0, 2, 4, 6, 8]
        assert seen == found and all(done.error is None and 0 <= done.seconds < 5 for done in found)

    def test_a_job_that_raises(self, tmp_path: Path, workers: int | None) -> None:
        found = by_index(list(run_jobs(function("fail_at_one"), tasks(4, tmp_path), workers=workers)))
        assert [done.result for done in found] == [0, None, 4, 6]
        error = found[1].error
        assert error is not None and (error.type, error.message) == ("ValueError", "no 1\nplease")
        assert "fail_at_one" in error.traceback and str(error) == "ValueError: no 1 please"

    def test_threads(self, tmp_path: Path, workers: int | None) -> None:
        before = torch.get_num_threads()
        for threads, wanted in ((None, 1), (3, 3)):
            found = list(
                run_jobs(function("process_and_threads"), tasks(4, tmp_path), workers=workers, threads=threads)
            )
            assert {done.result[1] for done in found if done.result} == {wanted}
            processes = {done.result[0] for done in found if done.result}
            assert len(processes) == (workers or 1) and (os.getpid() in processes) == (workers != 2)
        assert torch.get_num_threads() == before

    def test_no_jobs(self, workers: int | None) -> None:
        assert list(run_jobs(function("double"), [], workers=workers)) == []


class TestProcesses:
    @pytest.mark.parametrize("name", ["die_at_one", "exit_at_one"])
    def test_killed_twice(self, tmp_path: Path, name: str) -> None:
        found = by_index(list(run_jobs(function(name), tasks(5, tmp_path), workers=2)))
        assert [done.result for done in found] == [0, None, 4, 6, 8]
        error = found[1].error
        assert error is not None and error.type == "WorkerDied"
        assert error.message == (
            "the worker process was ended by SIGKILL, memory may have run out, twice"
            if name == "die_at_one"
            else "the worker process was ended with exit code 3, twice"
        )
        if name == "die_at_one":
            assert [(tmp_path / str(i)).read_text() for i in range(5)] == ["x", "xx", "x", "x", "x"]

    def test_killed_once(self, tmp_path: Path) -> None:
        found = by_index(list(run_jobs(function("die_once"), tasks(3, tmp_path), workers=2)))
        assert [done.result for done in found] == [0, 2, 4]

    def test_a_result_that_cannot_be_sent(self, tmp_path: Path) -> None:
        found = by_index(list(run_jobs(function("unspeakable"), tasks(3, tmp_path), workers=2)))
        assert [done.result for done in found] == [0, None, 2] and "lambda" in str(found[1].error)

    def test_left_early(self, tmp_path: Path) -> None:
        start = time.monotonic()
        iterator = run_jobs(function("slow_then_mark"), tasks(3, tmp_path), workers=2)
        assert next(iterator).index == 0
        iterator.close()  # type: ignore[attr-defined]
        assert time.monotonic() - start < 30 and not (tmp_path / "finished").exists()

    def test_caller_killed(self, tmp_path: Path) -> None:
        code = (
            "import os, sys; sys.path.insert(0, sys.argv[1])\n"
            "from pathlib import Path\n"
            "from engine_tasks import Task, process_and_threads\n"
            "from kcgs.engine import run_jobs\n"
            "if __name__ == '__main__':\n"
            "    tasks = [Task(i, Path()) for i in range(10_000)]\n"
            "    for done in run_jobs(process_and_threads, tasks, workers=2):\n"
            "        print(done.result[0], flush=True)\n"
            "        if done.index > 5: os.kill(os.getpid(), 9)\n"
        )
        script = tmp_path / "script.py"
        script.write_text(code)
        command = [sys.executable, str(script), str(Path(__file__).parent)]
        ended = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
        assert ended.returncode == -9
        workers = {int(line) for line in ended.stdout.split()}
        assert len(workers) == 2
        until = time.monotonic() + 20
        while any(_is_alive(process) for process in workers):
            assert time.monotonic() < until
            time.sleep(0.05)

    def test_same_bytes(self, tmp_path: Path) -> None:
        for threads in (1, 2):
            found = [
                by_index(list(run_jobs(function("fitted_bytes"), tasks(2, tmp_path), workers=w, threads=threads)))
                for w in (1, 2)
            ]
            assert [d.result for d in found[0]] == [d.result for d in found[1]]
            assert all(d.error is None for d in found[0])


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


def _is_alive(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
