"""The CPU kernel beyond what every backend is tested for: threads, memory, one pass, refusals."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from torch import Tensor

from kcgs import RegionMap
from kcgs.functional import region_splat, squared_error_gradients
from kcgs.kernels.cpu import lists, loops

RANDOM = torch.Generator()


@pytest.fixture
def scene() -> tuple[Tensor, ...]:
    RANDOM.manual_seed(0)
    means = torch.rand(600, 2, generator=RANDOM) * torch.tensor([150.0, 110.0])
    cholesky = torch.rand(600, 3, generator=RANDOM) * torch.tensor([6.0, 4.0, 6.0]) + torch.tensor([0.3, -2.0, 0.3])
    colors = torch.rand(600, 3, generator=RANDOM) - 0.2
    labels = torch.zeros(110, 150, dtype=torch.long)
    labels[20:70, 33:101] = 1
    labels[60:, 80:] = 2
    return means, cholesky, colors, torch.randint(0, 3, (600,), generator=RANDOM), labels


@pytest.fixture
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def render(scene: tuple[Tensor, ...], softness: float = 0.7) -> list[Tensor]:
    inputs = [t.clone().requires_grad_() for t in scene[:3]]
    regions = RegionMap(scene[4], softness)
    image = region_splat(*inputs, scene[3], regions, backend="cpu")
    image.square().sum().backward()
    return [image.detach(), *(t.grad for t in inputs if t.grad is not None)]


def crowd(seed: int = 0) -> tuple[Tensor, ...]:
    """Return so many Gaussians that seven threads are worth waking, a few of them wide."""
    generator = torch.Generator().manual_seed(seed)
    means = torch.rand(9000, 2, generator=generator) * torch.tensor([300.0, 220.0])
    sigma = torch.rand(9000, 1, generator=generator) * 3 + 0.5
    sigma[:: 100 + seed] *= 8.0
    cholesky = sigma * torch.tensor([1.0, 0.3, 0.7])
    labels = (torch.arange(300) >= 170).long().expand(220, 300).contiguous()
    ids = (means[:, 0] >= 170).long()
    return means, cholesky, torch.rand(9000, 3, generator=generator) * 0.1, ids, labels


def same(first: list[Tensor], second: list[Tensor]) -> bool:
    return all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


@pytest.mark.usefixtures("threads")
def test_same_bits_for_any_number_of_threads() -> None:
    results = []
    for count in (1, 2, 7):
        torch.set_num_threads(count)
        results.append(render(crowd()))
    assert all(same(results[0], other) for other in results[1:])


@pytest.mark.usefixtures("threads")
def test_renders_at_the_same_time() -> None:
    """Four threads of Python get the bits of one after the other."""
    torch.set_num_threads(2)
    scenes = [crowd(seed) for seed in range(4)]
    alone = [render(each) for each in scenes]
    with ThreadPoolExecutor(4) as pool:
        for _ in range(2):
            assert all(map(same, alone, pool.map(render, scenes)))


@pytest.mark.usefixtures("threads")
def test_forwards_before_a_backward() -> None:
    """Each keeps its lists; one backward may be repeated."""
    torch.set_num_threads(2)
    scenes = [crowd(seed) for seed in range(3)]
    alone = [render(each) for each in scenes]
    inputs = [[t.clone().requires_grad_() for t in each[:3]] for each in scenes]
    images = [
        region_splat(*leaves, each[3], RegionMap(each[4], 0.7), backend="cpu")
        for leaves, each in zip(inputs, scenes, strict=True)
    ]
    for k in (1, 0, 2):
        loss = images[k].square().sum()
        for retain in (True, False):
            gradients = torch.autograd.grad(loss, inputs[k], retain_graph=retain)
            assert same(alone[k], [images[k].detach(), *gradients])


FAULTS = """
import os, resource, torch
from kcgs import GaussianField, RegionMap
from kcgs.functional import region_splat, squared_error_gradients

torch.set_num_threads(2)
size = (480, 854)
labels = (torch.arange(854) >= 400).long().expand(size).contiguous()
field = GaussianField.random(1250, size, regions=labels, seed=0)
regions, image = RegionMap(labels, 0.7), torch.rand(3, *size)
tables = field.means, field.cholesky, field.colors

def forward():
    with torch.no_grad():
        region_splat(*tables, field.region_ids, regions, backend="cpu")

def both():
    region_splat(*tables, field.region_ids, regions, backend="cpu").sum().backward()

def one_pass():
    squared_error_gradients(image, *tables, field.region_ids, regions, cutoff=1e-4, backend="cpu")

for call in (forward, both, one_pass):
    for _ in range(5):
        call()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(10):
        call()
    print(call.__name__, (resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before) / 10, flush=True)

pid = os.fork()
forward()
if pid == 0:
    os._exit(0)
print("fork", os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="counts page faults as Linux does")
def test_page_faults_and_a_fork() -> None:
    """Calls find their memory in place: in a process of default settings, two threads, 480 x 854 pixels.

    Then both sides of a fork render.
    """
    environment = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}
    command = [sys.executable, "-W", "ignore", "-c", FAULTS]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=True)
    counts = {name: float(count) for name, count in map(str.split, done.stdout.splitlines())}
    assert counts.pop("fork") == 0
    assert len(counts) == 3 and max(counts.values()) <= 20, counts


@pytest.mark.parametrize("backend", ["cpu", "tiled"])
def test_one_pass_of_squared_error(scene: tuple[Tensor, ...], backend: str) -> None:
    regions, target = RegionMap(scene[4], 0.7), torch.rand(3, 110, 150, generator=RANDOM)
    leaves = [t.clone().requires_grad_() for t in scene[:3]]
    image = region_splat(*leaves, scene[3], regions, backend=backend)
    image.backward(image.detach() - target)
    got = squared_error_gradients(target, *scene[:4], regions, cutoff=1e-4, backend=backend)  # type: ignore[misc]
    assert all(b.grad is not None and torch.equal(a, b.grad) for a, b in zip(got, leaves, strict=True))


def test_gradient_that_is_not_contiguous(scene: tuple[Tensor, ...]) -> None:
    grads = []
    for view in (lambda t: t, lambda t: t.permute(1, 2, 0)):
        means = scene[0].clone().requires_grad_()
        image = region_splat(means, *scene[1:], backend="cpu")
        probe = torch.linspace(0, 1, image.numel()).view_as(image)
        (view(image) * view(probe)).sum().backward()
        grads.append(means.grad)
    assert torch.equal(*grads)


def test_float64(scene: tuple[Tensor, ...]) -> None:
    with pytest.raises(ValueError, match="backend 'cpu' computes in float32; got torch.float64"):
        region_splat(*(t.double() for t in scene[:3]), *scene[3:], backend="cpu")


def test_auto_is_this_kernel(scene: tuple[Tensor, ...]) -> None:
    assert torch.equal(region_splat(*scene), region_splat(*scene, backend="cpu"))
    double = [t.double() for t in scene[:3]]
    assert torch.equal(region_splat(*double, *scene[3:]), region_splat(*double, *scene[3:], backend="tiled"))


def test_compiled_once_for_all_channels(scene: tuple[Tensor, ...]) -> None:
    for channels in (1, 5):
        render((*scene[:2], scene[2].repeat(1, 2)[:, :channels], *scene[3:]))
    for loop in (lists.arrange, lists.measure, lists.list_pairs, loops.sum_rows):
        assert len(loop.signatures) == 1
