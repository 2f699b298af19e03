"""The renderers' benchmark in its quick form, and its parts."""

from __future__ import annotations

import copy
import csv
import math
from pathlib import Path

import pytest
import torch

from benchmarks import run
from benchmarks._render_runs import (
    DIRECT,
    EXACT,
    PEER,
    both,
    forward,
    in_turns,
    once,
    pairs_per_pixel,
    peer_fits,
    prepare,
    renderer,
)
from benchmarks._workloads import FITTED, SIZES, resized, standard, target_size, workload
from benchmarks.core.clocks import peak_bytes
from kcgs import GaussianField, Scene

FILES = {"report.md", "results.csv", "made.json", "error-against-time.png"}


def test_peer_renders_the_same_image() -> None:
    scene = workload(40, 60, 30)
    results = [once(renderer(name), scene, 1e-4) for name in (PEER, "cpu")]
    torch.testing.assert_close(results[0][1], results[1][1], rtol=1e-4, atol=1e-4)
    for got, want in zip(results[0][2], results[1][2], strict=True):
        assert (got - want).abs().max() < 2e-3 * want.abs().max()


def test_peer_is_left_out_where_memory_ends() -> None:
    assert peer_fits(standard("W2"), 1e-4) and not peer_fits(standard("W4"), 1 / 255)


def test_module_and_kernel_take_turns() -> None:
    """The module does what the kernel does, and more; by how much, a busy machine does not say."""
    kernel, module = in_turns(standard("W3"), 1e-4, 30)
    assert len(kernel) == len(module) == 30
    for quantity in ("forward", "sum"):
        least, whole = (min(getattr(timing, quantity) for timing in times) for times in (kernel, module))
        assert 0 < least < whole < 3 * least


def test_without_coarse_grids() -> None:
    """Both are near the exact sum, in gradients too, and are not the same."""
    scene = workload(96, 128, 12)
    want = both("reference", copy.deepcopy(scene).double(), 0.0)
    exact = both(EXACT, copy.deepcopy(scene).double(), 1e-12)
    assert all(torch.allclose(f, w, atol=1e-9) for f, w in zip([exact[0], *exact[1]], [want[0], *want[1]], strict=True))
    found = {name: both(name, scene, 1e-4) for name in ("cpu", DIRECT)}
    for image, gradients in found.values():
        assert (image - want[0]).abs().max() < 1e-3
        assert all((f - w).abs().max() < 5e-3 * w.abs().max() for f, w in zip(gradients, want[1], strict=True))
    (image, gradients), (other, others) = found.values()
    assert not torch.equal(image, other)
    assert not any(map(torch.equal, gradients, others))
    assert torch.equal(forward("cpu", scene, 1e-4)[0], image)  # again with grids


def test_pairs_are_counted() -> None:
    scene = workload(40, 60, 30)
    field = scene.field
    y, x = torch.meshgrid(torch.arange(40) + 0.5, torch.arange(60) + 0.5, indexing="ij")
    d = torch.stack([x, y], -1).double() - field.means.detach().double()[:, None, None]
    l11, l21, l22 = field.cholesky.detach().double()[..., None, None].unbind(1)
    z1 = d[..., 0] / l11
    z2 = (d[..., 1] - l21 * z1) / l22
    inside = int((torch.exp(-0.5 * (z1 * z1 + z2 * z2)) >= 1e-4).sum())
    assert pairs_per_pixel(DIRECT, scene, 1e-4) == inside / 2400
    # one of deviation 24: nodes 8 pixels apart, its variance there less by 8 * 8 / 3
    means, cholesky = torch.tensor([[150.0, 130.0]]), torch.tensor([[24.0, 0.0, 24.0]])
    one = Scene(GaussianField(means, cholesky, torch.ones(1, 3), size=(300, 300)))
    area = math.pi * 2 * math.log(1e4)
    assert 300 * 300 * pairs_per_pixel(DIRECT, one, 1e-4) == pytest.approx(area * 576, rel=0.01)
    assert 300 * 300 * pairs_per_pixel("cpu", one, 1e-4) == pytest.approx(area * (576 - 64 / 3) / 64, rel=0.05)


def test_fitted_scenes_and_sizes() -> None:
    soft, hard = (standard(f"{FITTED[1]} {contours}") for contours in ("soft", "hard"))
    assert soft.regions is not None and hard.regions is not None
    assert soft.regions.softness != 0 and hard.regions.softness == 0
    assert torch.equal(soft.regions.labels, hard.regions.labels) and soft.num_gaussians == hard.num_gaussians == 1_500
    assert [target_size(soft, size) for size in SIZES] == [(400, 600), (800, 1200), (2560, 3840)]
    (image, _), large = forward("cpu", resized(soft, (600, 900)), 1e-4), soft.render((600, 900))
    assert (image.clamp(0, 1) - large).abs().max() < 1e-6


def test_peak_memory_is_the_childs_own() -> None:
    ballast = torch.ones(60_000_000)  # a parent larger than the child must not hide the child's peak
    arguments = (PEER, "W3", 1e-4)
    assert peak_bytes(prepare, arguments, arguments) > 5 * 2**20
    del ballast


@pytest.mark.slow
def test_quick_report(tmp_path: Path) -> None:
    run("render", tmp_path, quick=True)
    assert {path.name for path in tmp_path.iterdir()} == FILES
    with (tmp_path / "results.csv").open() as file:
        sections = {row["section"] for row in csv.DictReader(file)}
    assert sections == {"speed", "grids", "overhead", "memory", "error", "growth", "stiffness"}
