"""The same jobs on a real Ray cluster of two processors, which all tests here share."""

from __future__ import annotations

import json
import logging
import os
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import torch

from kcgs.cli import main
from kcgs.data import save_image
from kcgs.engine import run_jobs

ray = pytest.importorskip("ray", reason="needs the package ray: pip install ray")


@pytest.fixture(scope="session")
def cluster(importable: None) -> Iterator[None]:
    path = os.pathsep.join(filter(None, sys.path))
    with pytest.MonkeyPatch.context() as environment:
        # by default workers have niceness 15: on a busy machine they would hardly run
        environment.setenv("RAY_worker_niceness", "0")
        ray.init(
            "local", num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR,
            runtime_env={"env_vars": {"PYTHONPATH": path}},
        )  # fmt: skip
        yield
        ray.shutdown()


def run(name: str, count: int, folder: Path, **options: Any) -> Iterator[tuple[int, Any]]:
    module = import_module("engine_tasks")
    tasks = [module.Task(number, folder) for number in range(count)]
    return run_jobs(getattr(module, name), tasks, **{"engine": "ray", **options})


@pytest.mark.usefixtures("cluster")
class TestCluster:
    def test_same_bytes_as_local_until_a_job_raises(self, tmp_path: Path) -> None:
        ((_, (threads, content)),) = run("fit_zero", 1, tmp_path, engine="local", threads=2)
        outcomes = run("fit_zero", 2, tmp_path, threads=2)  # one at a time
        assert threads == 2 and next(outcomes) == (0, (2, content))
        with pytest.raises(ValueError, match="no 1"):
            next(outcomes)

    def test_a_killed_worker(self, tmp_path: Path) -> None:
        with pytest.raises(RuntimeError, match="a worker process was killed"):
            list(run("die_at_one", 2, tmp_path, workers=1))

    def test_more_threads_than_a_node_has(self, tmp_path: Path) -> None:
        with pytest.raises(ValueError, match="threads must be at most the processors of a node of the cluster; got 3"):
            list(run("double", 1, tmp_path, threads=3))


@pytest.mark.slow
def test_fit_many_on_a_cluster_of_its_own(
    importable: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without a cluster to join, one is started and shut down again."""
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.chdir(tmp_path)
    ray.shutdown()
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
    assert not ray.is_initialized()
