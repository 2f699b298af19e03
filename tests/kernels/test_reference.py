"""The oracle's chunks."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch
from torch import Tensor

from kcgs.functional import region_splat
from kcgs.kernels import reference


@pytest.mark.slow
def test_480x854_with_7500_gaussians_in_2_gib() -> None:
    code = (
        "import resource, torch\n"
        "from kcgs import GaussianField, RegionSplatRenderer\n"
        "field = GaussianField.random(7500, (480, 854), seed=0)\n"
        "RegionSplatRenderer(backend='reference')(field).sum().backward()\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, float(field.colors.grad.min()))\n"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    peak, least = (float(v) for v in out.stdout.split())
    assert peak < 2.0
    assert least > 0


def test_chunks_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    labels = torch.tensor([[0, 0, 1], [0, 1, 1]])
    generator = torch.Generator().manual_seed(0)
    means, colors = (3 * torch.rand(2, k, generator=generator, dtype=torch.float64) for k in (2, 1))
    factors = torch.tensor([[1.0, 0.2, 0.8], [0.7, -0.1, 1.2]], dtype=torch.float64)

    def render(*gaussians: Tensor) -> Tensor:
        return region_splat(*gaussians, torch.tensor([0, 1]), labels, cutoff=0.0, backend="reference")

    inputs = [t.requires_grad_() for t in (means, factors, colors)]
    whole = render(*inputs)
    monkeypatch.setattr(reference, "_CHUNK_WEIGHTS", 4)
    torch.testing.assert_close(render(*inputs), whole)
    assert torch.autograd.gradcheck(render, inputs)
    assert torch.autograd.gradgradcheck(render, inputs)
