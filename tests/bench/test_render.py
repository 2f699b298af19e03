"""The renderers' benchmark in its quick form, and its parts."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
import torch

from kcgs.bench import run
from kcgs.bench.render.limit import evaluated_pairs
from kcgs.bench.render.peers import PEERS, pairs
from kcgs.bench.render.timing import drawer, once, peak_memory, probe_of
from kcgs.bench.render.workloads import standard, workload


@pytest.mark.parametrize("peer", PEERS)
def test_peers_draw_the_same_picture(peer: str) -> None:
    scene = workload("small", 40, 60, 30)
    results = [once(drawer(name), scene, 1e-4, probe_of(scene)) for name in (peer, "cpu")]
    torch.testing.assert_close(results[0][1], results[1][1], rtol=1e-4, atol=1e-4)
    for got, want in zip(results[0][2], results[1][2], strict=True):
        assert (got - want).abs().max() < 2e-3 * want.abs().max()


def test_pairs_are_counted() -> None:
    scene = standard("W3")
    assert pairs("dense autograd", scene, 1e-4) == 20 * 200 * 300
    assert 0 < evaluated_pairs(scene, 1e-2) < evaluated_pairs(scene, 1e-4) < 20 * 200 * 304


def test_peak_memory_is_the_childs_own() -> None:
    ballast = torch.ones(60_000_000)  # a parent larger than the child must not hide the child's peak
    assert peak_memory("dense autograd", "W3", 1e-4) > 5
    del ballast


@pytest.mark.slow
def test_quick_report(tmp_path: Path) -> None:
    run("render", tmp_path, quick=True)
    assert {"report.md", "results.csv", "error-against-time.png", "growth.png", "stiffness.png"} == {
        p.name for p in tmp_path.iterdir()
    }
    with (tmp_path / "results.csv").open() as file:
        sections = {row["section"] for row in csv.DictReader(file)}
    assert sections == {"limit", "speed", "overhead", "memory", "error", "growth", "stiffness"}
