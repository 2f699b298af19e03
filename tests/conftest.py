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
