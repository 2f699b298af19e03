"""Filters that tests/test_triton.py runs in a process of their own: on a GPU, or with TRITON_INTERPRET=1 in numpy."""

from __future__ import annotations

import pytest
import torch

from kcgs.fitting import pursuit

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


# 550 pixels are more than those of a program
@pytest.mark.parametrize(("size", "num_maps"), [((5, 110), 2), ((1, 3), 1), ((40, 2), 0)])
def test_filters_as_compiled_loops(size: tuple[int, int], num_maps: int, monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(0)
    planes = torch.rand(2, 3, *size, generator=generator).to(DEVICE)
    labels = torch.randint(0, 2, (num_maps, *size), generator=generator).to(planes) if num_maps else None
    pair = []
    for is_taken in (False, True):
        monkeypatch.setattr(pursuit, "takes_triton", lambda *tensors: is_taken)  # noqa: B023
        pair.append(torch.cat([part.view(-1, *size) for part in pursuit._gains(planes, labels, 1.3)]))
    torch.testing.assert_close(*pair)
    assert not torch.equal(pair[0][0], pair[0][1])
