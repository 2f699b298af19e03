"""Fits beside other programs."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import time

import pytest
import torch

from kcgs.fit import fit

# matrix products on all cores, which leave threads that spin between them
_NEIGHBOUR = "import torch\na = torch.rand(500, 500)\nwhile True: a @ a"
_MOST = 1.5


@pytest.mark.slow
def test_a_fit_gets_its_fair_share() -> None:
    image = torch.rand(3, 200, 300, generator=torch.Generator().manual_seed(0))

    def seconds() -> float:
        start = time.perf_counter()
        fit(image, None, 300, iterations=150)
        return time.perf_counter() - start

    seconds()
    alone, beside = list[float](), list[float]()
    for _ in range(3):
        alone.append(seconds())
        with subprocess.Popen([sys.executable, "-c", _NEIGHBOUR]) as neighbour:
            try:
                time.sleep(4)  # it imports torch
                beside.append(seconds())
            finally:
                neighbour.kill()
    # the neighbour wants all the cores, as the fit may: half of them for each
    assert os.cpu_count() and statistics.median(beside) <= _MOST * 2 * statistics.median(alone)
