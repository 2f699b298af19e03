"""The same jobs on a real Ray cluster of two processors, which all tests here share."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from kcgs.engine import Done, run_jobs
from kcgs.engine.cluster import connected

ray = pytest.importorskip("ray", reason="needs the package ray: pip install 'kcgs[ray]'")


@pytest.fixture(scope="session")
def cluster(importable: None) -> Iterator[None]:
    patch = pytest.MonkeyPatch()
    patch.delenv("RAY_ADDRESS", raising=False)
    with patch.context(), connected(2, 1):
        yield
    assert not ray.is_initialized()  # what was started here is shut down


def run(name: str, count: int, folder: Path, **options: Any) -> list[Done[Any]]:
    module = import_module("engine_tasks")
    tasks = [module.Task(number, folder) for number in range(count)]
    found = list(run_jobs(getattr(module, name), tasks, **{"engine": "ray", **options}))
    assert sorted(done.index for done in found) == list(range(count))
    return sorted(found, key=lambda done: done.index)


@pytest.mark.usefixtures("cluster")
class TestCluster:
    def test_results_and_a_job_that_raises(self, tmp_path: Path) -> None:
        found = run("fail_at_one", 4, tmp_path)
        assert [done.result for done in found] == [0, None, 4, 6]
        error = found[1].error
        assert error is not None and (error.type, error.message) == ("ValueError", "no 1\nplease")
        assert "fail_at_one" in error.traceback

    def test_killed(self, tmp_path: Path) -> None:
        found = run("die_at_one", 3, tmp_path)
        assert [done.result for done in found] == [0, None, 4]
        assert found[1].error is not None and found[1].error.type == "WorkerDied"
        assert (tmp_path / "1").read_text() == "xx"
        assert [done.result for done in run("die_once", 3, tmp_path)] == [0, 2, 4]

    def test_same_bytes_as_local(self, tmp_path: Path) -> None:
        for threads in (1, 2):
            here, there = (run("fitted_bytes", 2, tmp_path, engine=e, threads=threads) for e in ("local", "ray"))
            assert [d.result for d in here] == [d.result for d in there] and all(d.error is None for d in here)

    def test_threads(self, tmp_path: Path) -> None:
        assert {done.result[1] for done in run("process_and_threads", 3, tmp_path, threads=2)} == {2}
        with pytest.raises(ValueError, match="threads must be at most 2, what a node of the cluster has; got 3"):
            run("double", 1, tmp_path, threads=3)

    def test_a_result_that_cannot_be_sent(self, tmp_path: Path) -> None:
        # Ray can send more than pickle: what fails is a module that the workers do not have
        found = run("unspeakable", 3, tmp_path)
        assert [found[0].result, found[2].result] == [0, 2]
