"""The same jobs on a real Ray cluster of two processors, which all tests here share."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import torch

from kcgs.cli import main
from kcgs.data import save_image
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
        assert [done.result and done.result[0] for done in found] == [0, None, 4, 6]
        error = found[1].error
        assert error is not None and (error.type, error.message) == ("ValueError", "no 1\nplease")
        assert "fail_at_one" in error.traceback

    def test_killed(self, tmp_path: Path) -> None:
        found = run("misbehave", 3, tmp_path)
        assert [done.result for done in found] == [0, None, 4]
        assert found[1].error is not None and found[1].error.type == "WorkerDied"
        assert [(tmp_path / str(i)).read_text() for i in range(3)] == ["x", "xx", "xx"]

    def test_same_bytes_as_local(self, tmp_path: Path) -> None:
        # on two threads; test_fit_many is on one
        here, there = (run("fitted_bytes", 1, tmp_path, engine=engine, threads=2) for engine in ("local", "ray"))
        assert here[0].error is None and here[0].result == there[0].result

    def test_threads(self, tmp_path: Path) -> None:
        assert {done.result[1] for done in run("process_and_threads", 3, tmp_path, threads=2)} == {2}
        with pytest.raises(ValueError, match="threads must be at most 2, what a node of the cluster has; got 3"):
            run("fail_at_one", 1, tmp_path, threads=3)

    def test_fit_many(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        monkeypatch.chdir(tmp_path)
        for name in ("a", "b"):
            save_image(f"{name}.png", torch.linspace(0, 1, 60 + ord(name)).expand(3, 40, -1))
        scenes = []
        for engine in ("local", "ray"):
            options = ["-n", "12", "--iterations", "5", "--regions", "none", "--json", "--workers", "1"]
            command = ["kcgs", "fit-many", "a.png", "b.png", "-o", engine, "--engine", engine, *options]
            monkeypatch.setattr(sys, "argv", command)
            with pytest.raises(SystemExit) as stop:
                main()
            out, err = capsys.readouterr()
            assert not stop.value.code, err
            assert json.loads(out)["fitted"] == 2
            scenes.append([(tmp_path / engine / f"{name}.safetensors").read_bytes() for name in ("a", "b")])
        assert scenes[0] == scenes[1]
