"""Fixtures that every test may use."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, settings
from torch import Tensor

from kcgs.kernels import BACKENDS

# Images of tests are small: a second thread costs more in waking and spinning than it saves, and workers that share
# the processors would wait for one another. Tests of threads set their number.
if "OMP_NUM_THREADS" not in os.environ:
    os.environ["OMP_NUM_THREADS"] = "1"  # of processes that tests start
    torch.set_num_threads(1)

ROOT = Path(__file__).resolve().parent.parent

# The same examples in each run, however long they take.
settings.register_profile(
    "kcgs",
    derandomize=True,
    deadline=None,
    suppress_health_check=(HealthCheck.too_slow, HealthCheck.function_scoped_fixture),
)
settings.load_profile("kcgs")

# The files that take longest, 10 seconds and more, by their time: workers begin with them, so that the last file to end
# is a short one. (By itself pytest-xdist begins with the files of most tests, and these have few.)
# The first two go to two workers: golden compiles every kernel, and pages run in processes of their own.
LONGEST = (
    "golden/test_golden.py",
    "docs/test_pages.py",
    "benchmarks/test_quick.py",
    "notebooks/test_notebooks.py",
    "docs/test_site.py",
    "engine/test_ray.py",
    "test_triton.py",
    "export/test_element.py",
    "pipelines/test_torch_transforms.py",
    "test_wheel.py",
    "engine/test_local.py",
    "cli/test_cli.py",
    "export/test_web.py",
    "test_memory.py",
    "cli/test_many.py",
    "onnx/test_scene.py",
    "compiled/test_threads.py",
    "video/test_fitting.py",
    "rate/test_fitting.py",
    "test_parallel.py",
    "onnx/test_torch_export.py",
    "kernels/test_cpu.py",
    "codec/test_label_files.py",
    "test_package.py",
    "rate/test_compress.py",
)


def pytest_configure(config: pytest.Config) -> None:
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False  # files go to workers in the order of LONGEST
    if importlib.util.find_spec("triton") is None:
        config.option.ignore = [*(config.option.ignore or []), *map(str, modules_of_triton())]


def modules_of_triton() -> list[Path]:
    """List what cannot be imported without Triton; it has no doctests, and tests of it skip and say so."""
    kernels = [path for path in ROOT.glob("kcgs/**/*.py") if "\nimport triton" in path.read_text(encoding="utf-8")]
    return [*kernels, *ROOT.glob("tests/*/triton_*.py")]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    ranks = {ROOT / "tests" / name: rank for rank, name in enumerate(LONGEST)}
    items.sort(key=lambda item: ranks.get(item.path, len(ranks)))


DEVICES = ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",)
DTYPES = ("float16", "bfloat16", "float32", "float64")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--device", default="cpu", help=f"of tests of operations: all, or some of {', '.join(DEVICES)}")
    parser.addoption("--dtype", default="float32", help=f"the same: all, or some of {', '.join(DTYPES)}")


def _selection(config: pytest.Config, option: str, values: tuple[str, ...]) -> tuple[str, ...]:
    text = config.getoption(option)
    selection = values if text == "all" else tuple(text.split(","))
    if unknown := set(selection) - set(values):
        raise pytest.UsageError(f"{option} must be all, or some of {', '.join(values)}; got {', '.join(unknown)}")
    return selection


def _backends(device: str) -> list[str]:
    """Name the kernels that take tensors of a device; Triton's interpreter runs that of CUDA in numpy, slowly."""
    interpreted = {"cuda"} if os.environ.get("TRITON_INTERPRET") == "1" else set()
    others = {"cpu", "cuda", "auto"} - {device} - interpreted
    return [name for name in BACKENDS if name not in others]


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run tests that ask for `device`, `dtype` or `backend` with each that the command line selects.

    A test without `device` runs on the CPU; kernels of one dtype are left out where `dtype` is another.
    """
    tables = [mark.args[0] for mark in metafunc.definition.iter_markers("parametrize")]
    parametrized = {name for table in tables for name in (table.split(",") if isinstance(table, str) else table)}
    names = [n for n in ("backend", "device", "dtype") if n in metafunc.fixturenames and n not in parametrized]
    if not names:
        return
    rows = []
    for device in _selection(metafunc.config, "--device", DEVICES) if "device" in names else ("cpu",):
        for dtype in _selection(metafunc.config, "--dtype", DTYPES) if "dtype" in names else ("",):
            for backend in _backends(device) if "backend" in names else ("",):
                if dtype != "float64" or backend not in ("cpu", "cuda"):
                    row = {"backend": backend, "device": torch.device(device), "dtype": getattr(torch, dtype, None)}
                    texts = {"backend": backend, "device": device, "dtype": dtype}
                    rows.append(pytest.param(*(row[n] for n in names), id="-".join(texts[n] for n in names)))
    metafunc.parametrize(names, rows)


def pytest_runtest_setup() -> None:
    """Seed torch's global generator, from which tests and their fixtures draw."""
    torch.manual_seed(0)


class Clock:
    """A clock that moves on by a tick each time it is read."""

    TICK = 0.005  # seconds

    def __init__(self) -> None:
        self.seconds = 0.0

    def __call__(self) -> float:
        self.advance(self.TICK)
        return self.seconds

    def advance(self, seconds: float) -> None:
        self.seconds += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """Replace `time.perf_counter`, so that time limits do not depend on how busy the machine is."""
    clock = Clock()
    monkeypatch.setattr("time.perf_counter", clock)
    return clock


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
