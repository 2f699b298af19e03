"""The renderers' benchmark in its quick form, and its parts."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
import torch

from kcgs.bench import run
from kcgs.bench._render_runs import PEER, in_turns, once, peer_fits, prepare, renderer
from kcgs.bench._workloads import standard, workload
from kcgs.bench.core.clocks import peak_bytes

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
    assert sections == {"speed", "overhead", "memory", "error", "growth", "stiffness"}
