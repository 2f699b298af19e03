"""The benchmark of label maps as files."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
import torch

import benchmarks
from benchmarks import labels as bench
from kcgs.data import save_labels

MAPS = ("bsds/12/mask.png", "bsds/34/mask.png")


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """Two maps where BSDS has them."""
    rng = np.random.default_rng(0)
    for name, regions in {"12": 3, "34": 300}.items():
        (tmp_path / "data/bsds" / name).mkdir(parents=True)
        labels = np.kron(rng.integers(0, regions, (20, 30)), np.ones((2, 2), np.int64))
        save_labels(tmp_path / "data/bsds" / name / "mask.png", torch.from_numpy(labels))
    return tmp_path / "data"


def test_report(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "find_spec", lambda name: name if name in ("kcgs", "PIL") else None)
    benchmarks.run("labels", tmp_path / "out", data=data)
    with (tmp_path / "out/results.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["map"], row["codec"]) for row in rows] == [(m, c) for m in MAPS for c in ("kcgs", "PNG", "WebP")]
    assert all(int(row["bytes"]) > 50 and float(row["decode_seconds"]) > 0 for row in rows)
    text = (tmp_path / "out/report.md").read_text()
    assert (
        "- JPEG XL is left out: its package pillow_jxl is missing" in text and "- COCO-Stuff is not in the data" in text
    )
    assert "| BSDS500 | 2 | WebP |" in text and "100.0 %" in text


def test_no_maps(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="data must have maps such as"):
        benchmarks.run("labels", tmp_path / "out", data=tmp_path)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of pycocotools
def test_others_that_are_there_come_back() -> None:
    labels = torch.arange(60).view(6, 10) // 7
    results = bench.measure("set", "map", lambda: labels, 1)
    assert {"kcgs", "PNG", "WebP"} <= {r.codec for r in results}
    assert {(r.pixels, r.regions) for r in results} == {(60, 9)}


def test_a_loss_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    lossy = bench.CODECS["PNG"]._replace(decode=lambda data: np.zeros((6, 10)))
    monkeypatch.setitem(bench.CODECS, "PNG", lossy)
    with pytest.raises(RuntimeError, match="PNG loses labels of set map"):
        bench.measure("set", "map", lambda: torch.arange(60).view(6, 10), 1)
