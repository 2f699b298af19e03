"""The oracle's memory stays flat, whatever the scene."""

from __future__ import annotations

import subprocess
import sys

import pytest


@pytest.mark.slow
def test_480x854_with_7500_gaussians_in_2_gib() -> None:
    code = (
        "import resource, torch\n"
        "from kcgs import GaussianField, RegionSplatRenderer\n"
        "field = GaussianField.random(7500, (480, 854), seed=0)\n"
        "RegionSplatRenderer(backend='reference')(field).sum().backward()\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, float(field.colors.grad.min()))\n"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=600)
    peak, least = (float(v) for v in out.stdout.split())
    assert peak < 2.0
    assert least > 0
