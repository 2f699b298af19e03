"""Fits beside other programs."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
from typing import IO

import pytest

CORES = os.cpu_count() or 1
MOST = 1.5
# threads of torch that wait for work spin, in the fit's process and beside it
_ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": str(CORES), "NUMBA_NUM_THREADS": str(CORES)}
_NEIGHBOUR = """
import torch
a = torch.rand(500, 500)
a @ a
print("ready", flush=True)
while True: a @ a
"""
_FIT = """
import sys, time, torch
from kcgs.fitting import fit
image = torch.rand(3, 200, 300, generator=torch.Generator().manual_seed(0))
fit(image, None, 300, iterations=150)
for _ in sys.stdin:
    start = time.perf_counter()
    fit(image, None, 300, iterations=150)
    print(time.perf_counter() - start, flush=True)
"""


def start(program: str) -> subprocess.Popen[str]:
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    return subprocess.Popen([sys.executable, "-c", program], env=_ENVIRONMENT, text=True, **pipes)  # type: ignore[call-overload, no-any-return]


def ask(process: subprocess.Popen[str]) -> float:
    ins: IO[str] | None = process.stdin
    outs: IO[str] | None = process.stdout
    assert ins is not None and outs is not None
    ins.write("\n")
    ins.flush()
    return float(outs.readline())


@pytest.mark.slow
@pytest.mark.skipif(CORES < 2, reason="one core has no room for threads that spin")
def test_a_fit_gets_its_fair_share() -> None:
    alone, beside = list[float](), list[float]()
    with start(_FIT) as fits:
        for _ in range(3):
            alone.append(ask(fits))
            with start(_NEIGHBOUR) as neighbour:
                assert neighbour.stdout is not None and neighbour.stdout.readline() == "ready\n"
                beside.append(ask(fits))
                assert neighbour.poll() is None
                neighbour.kill()
        fits.kill()
    # the neighbour wants all the cores, as the fit may: half of them for each
    assert statistics.median(beside) <= MOST * 2 * statistics.median(alone)
