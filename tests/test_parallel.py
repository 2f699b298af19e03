"""Data-parallel training. Each process of a group is a program of its own, so that none can hold the tests up."""

from __future__ import annotations

import os
import subprocess
import sys
from datetime import timedelta
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from kcgs import GaussianField, RegionMap, RegionSplatRenderer, Scene

SIZE = (20, 30)
TARGETS = (0.2, 0.8)
PATIENCE = timedelta(minutes=5)  # of processes that wait for one another


class Toned(nn.Module):
    """A scene and an ordinary layer: what a user would train."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        regions = RegionMap.from_labels((torch.arange(SIZE[1]) // 11).expand(SIZE), 0.8)
        self.scene = Scene(GaussianField.random(40, SIZE, regions=regions, seed=0), regions)
        self.render, self.tone = RegionSplatRenderer(), nn.Conv2d(3, 3, 1)

    def forward(self, exposure: Tensor) -> Tensor:
        return self.tone(exposure * self.render(self.scene)[None])


def train(module: nn.Module, targets: tuple[float, ...]) -> dict[str, Tensor]:
    """Take three steps towards the mean of the targets."""
    optimizer = torch.optim.SGD(module.parameters(), lr=0.5)
    for _ in range(3):
        optimizer.zero_grad()
        image = module(torch.ones(1))
        torch.stack([(image - target).square().mean() for target in targets]).mean().backward()
        optimizer.step()
    return {name: p.detach() for name, p in module.named_parameters()}


def train_as(rank: int, processes: int, folder: Path) -> None:
    """Train as one process of a group and save what came out. A process that cannot reach the others says so by 77."""
    os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")
    try:
        torch.distributed.init_process_group(
            "gloo", init_method=f"file://{folder}/group", rank=rank, world_size=processes, timeout=PATIENCE
        )
        torch.distributed.all_reduce(torch.ones(1))
    except RuntimeError as error:
        print(error, file=sys.stderr, flush=True)
        os._exit(77)
    (folder / f"{rank}.met").touch()
    wrapped = nn.parallel.DistributedDataParallel(Toned())
    targets = TARGETS if processes == 1 else (TARGETS[rank],)
    state = train(wrapped, targets)
    torch.save({name.removeprefix("module."): value for name, value in state.items()}, folder / f"{rank}.pt")
    os._exit(0)  # the group's own end may wait for ever on a busy machine


@pytest.mark.skipif(not torch.distributed.is_available(), reason="torch is built without distributed")
@pytest.mark.parametrize("processes", [1, 2])
def test_trains_as_one_process_does(processes: int, tmp_path: Path) -> None:
    """Wrapped for one process the module trains as it does alone; two, each with a target, follow the mean."""
    given = [str(processes), str(tmp_path)]
    group = [
        subprocess.Popen([sys.executable, __file__, str(rank), *given], stderr=subprocess.PIPE, text=True)
        for rank in range(processes)
    ]
    said = "\n".join(process.communicate()[1] for process in group)
    if len(list(tmp_path.glob("*.met"))) < processes:
        pytest.skip(f"processes of torch.distributed cannot reach each other here: {said.strip() or 'no answer'}")
    assert [process.returncode for process in group] == [0] * processes, said
    states = [torch.load(tmp_path / f"{rank}.pt", weights_only=True) for rank in range(processes)]
    want, before = train(Toned(), TARGETS), dict(Toned().named_parameters())
    assert set(states[0]) == set(want)
    for name, value in want.items():
        torch.testing.assert_close(states[0][name], value, rtol=1e-4, atol=1e-6)
        assert torch.equal(states[0][name], states[-1][name])
        assert not torch.allclose(value, before[name], rtol=1e-4)


if __name__ == "__main__":
    train_as(int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3]))
