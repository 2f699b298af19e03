"""Data-parallel training. The group is a program of its own, so that it cannot hold the tests up."""

from __future__ import annotations

import os
import subprocess
import sys
from datetime import timedelta
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from kcgs import GaussianField, RegionSplatRenderer, Scene

TARGETS = (0.2, 0.8)
PATIENCE = timedelta(minutes=5)  # of processes that wait for one another
UNREACHABLE = 77  # exit status, as of a skipped test in automake


class Toned(nn.Module):
    """A scene and an ordinary layer: what a user would train."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.scene = Scene(GaussianField.random(40, (20, 30), seed=0))
        self.render, self.tone = RegionSplatRenderer(backend="tiled"), nn.Conv2d(3, 3, 1)  # no compiled loops to load

    def forward(self) -> Tensor:
        return self.tone(self.render(self.scene)[None])


def train(module: nn.Module, targets: tuple[float, ...]) -> dict[str, Tensor]:
    """Take three steps towards the mean of the targets."""
    optimizer = torch.optim.SGD(module.parameters(), lr=0.5)
    for _ in range(3):
        optimizer.zero_grad()
        image = module()
        torch.stack([(image - target).square().mean() for target in targets]).mean().backward()
        optimizer.step()
    return {name: p.detach() for name, p in module.named_parameters()}


def train_as(rank: int, folder: Path) -> int:
    """Train as one process of the group, save the parameters and return the exit status."""
    os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")
    try:
        torch.distributed.init_process_group(
            "gloo", init_method=f"file://{folder}/group", rank=rank, world_size=len(TARGETS), timeout=PATIENCE
        )
        torch.distributed.all_reduce(torch.ones(1))
    except RuntimeError as error:
        print(error, file=sys.stderr, flush=True)
        return UNREACHABLE
    parameters = train(nn.parallel.DistributedDataParallel(Toned()), (TARGETS[rank],))
    torch.save({name.removeprefix("module."): value for name, value in parameters.items()}, folder / f"{rank}.pt")
    return 0


@pytest.mark.skipif(not torch.distributed.is_available(), reason="torch is built without distributed")
def test_trains_as_one_process_does(tmp_path: Path) -> None:
    """Two processes, each with a target, follow the mean of the targets, as one process does that has both."""
    group = subprocess.run([sys.executable, __file__, str(tmp_path)], stderr=subprocess.PIPE, text=True)
    if group.returncode == UNREACHABLE:
        pytest.skip(f"processes of torch.distributed cannot reach each other here: {group.stderr.strip()}")
    assert group.returncode == 0, group.stderr
    first, second = (torch.load(tmp_path / f"{rank}.pt", weights_only=True) for rank in range(len(TARGETS)))
    expected, start = train(Toned(), TARGETS), dict(Toned().named_parameters())
    assert set(first) == set(second) == set(expected)
    for name, value in expected.items():
        torch.testing.assert_close(first[name], value, rtol=1e-4, atol=1e-6)
        assert torch.equal(first[name], second[name])
        assert not torch.allclose(value, start[name], rtol=1e-4)


if __name__ == "__main__":
    import torch._dynamo  # as optimizers do: here, once for both processes

    child = os.fork()
    status = train_as(0 if child else 1, Path(sys.argv[1]))
    if child:
        status = status or os.waitstatus_to_exitcode(os.wait()[1])
    os._exit(status)  # the group's own end may wait for ever on a busy machine
