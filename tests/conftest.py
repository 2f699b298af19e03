"""Fixtures that every test may use."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch
from torch import Tensor

from kcgs.kernels import BACKENDS

# Pictures of tests are small: a second thread costs more in waking and spinning than it saves, and workers that share
# the processors would wait for one another. Threads have tests of their own, which say how many.
if "OMP_NUM_THREADS" not in os.environ:
    os.environ["OMP_NUM_THREADS"] = "1"  # of processes that tests start
    torch.set_num_threads(1)

ROOT = Path(__file__).resolve().parent.parent


# Files that take longest, 12 seconds of a processor and more: workers begin with them, so that none is left with one at
# the end. (By itself pytest-xdist begins with the files of most tests, and these have few.)
LONGEST = (
    "notebooks/test_notebooks.py",
    "golden/test_golden.py",
    "export/test_web.py",
    "cli/test_cli.py",
    "engine/test_ray.py",
    "cli/test_many.py",
    "engine/test_local.py",
    "kernels/test_cuda.py",
    "kernels/test_cpu.py",
    "fit/test_best.py",
    "bench/test_decode.py",
    "test_wheel.py",
    "segment/test_classical.py",
    "bench/test_experiments.py",
    "export/test_decode.py",
    "fit/test_loop.py",
    "docs/test_site.py",
    "docs/test_pages.py",
)


def pytest_configure(config: pytest.Config) -> None:
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False  # files go to workers in the order below


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    ranks = {ROOT / "tests" / name: rank for rank, name in enumerate(LONGEST)}
    items.sort(key=lambda item: ranks.get(item.path, len(ranks)))


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--device", default="cpu", help="device of the kernel tests: cpu or cuda")


@pytest.fixture
def device(request: pytest.FixtureRequest) -> torch.device:
    return torch.device(request.config.getoption("--device"))


@pytest.fixture(params=[b for b in BACKENDS if b not in ("auto", "cuda")])
def backend(request: pytest.FixtureRequest) -> str:
    """Name a kernel that runs on the CPU; the one that does not has cases of its own in tests/kernels."""
    return request.param


@pytest.fixture(scope="session")
def data_root() -> Path:
    """Real images with masks, outside the project."""
    root = (ROOT / os.environ.get("KCGS_DATA", "../shared/data")).resolve()
    if not root.is_dir():
        pytest.skip(f"no data folder at {root}; set KCGS_DATA")
    return root


@pytest.fixture(scope="session")
def astronaut() -> Tensor:
    from skimage import data

    return torch.from_numpy(data.astronaut()).permute(2, 0, 1).float() / 255
