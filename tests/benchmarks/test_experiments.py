"""Charts, davis, ablation and convergence: plans, arithmetic, and each in its quick form."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import pytest
import torch

import benchmarks
from benchmarks import ablation, charts, convergence, davis
from benchmarks._siren import BYTES_PER_WEIGHT, train, weights_of, width_for
from benchmarks.core.cases import BASELINE, CLAMPED, PAPER, PAPER_CLAMPED, UNCLAMPED
from benchmarks.core.images import load
from benchmarks.core.options import Options
from benchmarks.core.store import Row
from kcgs.fitting import HistoryEntry


def row(image: str = "a", n: int = 1_250, method: str = "best", psnr: float = 30.0, **values: Any) -> Row:
    figures = {"psnr": psnr, "ms_ssim": 0.9, "ef_psnr": psnr - 1, "ef_ssim": 0.8}
    fixed: dict[str, Any] = {**figures, **{f"decoded_{key}": value for key, value in figures.items()}}
    fixed |= {"seed": 0, "iterations": 700, "seconds": 1.0, "core_seconds": 1.0, "num_gaussians": n, "pixels": 8_000}
    return Row(image=image, n=n, method=method, **{**fixed, "bytes": 1_000, "map_bytes": 100, **values})


class TestConvergence:
    def test_against_paper(self) -> None:
        history = tuple(HistoryEntry(i, 10.0 * i, 0.0, 20.0 + i, 19.0 + i, 5) for i in range(1, 6))
        paper = row(method="paper", psnr=24.0, ef_psnr=23.0, seconds=50.0, core_seconds=25.0)
        ours = row(psnr=25.0, seconds=40.0, core_seconds=40.0, ef_psnr=30.0)
        steps = [step for fit in (paper, ours) for step in convergence.in_core_seconds(fit, history)]
        assert [step.seconds for step in steps[:5]] == [5.0, 10.0, 15.0, 20.0, 25.0]
        text = convergence.against_paper([paper, ours], steps)
        assert "took 25 s and ends at 24.00 dB" in text
        assert "| best | 40 | 1 | 40 | 1 | 40 | +1.00 | +7.00 |" in text

    def test_network_fits(self) -> None:
        width = width_for(2_000)
        assert BYTES_PER_WEIGHT * weights_of(width) <= 2_000 < BYTES_PER_WEIGHT * weights_of(width + 1)
        image = torch.linspace(0, 1, 48).expand(3, 32, 48)
        made = train(image, 2_000, seconds=0.2)
        assert made.render.shape == image.shape and made.bytes <= 2_000 and made.iterations > 0
        before = torch.random.get_rng_state()
        train(image, 100, seconds=0.01)
        assert torch.equal(torch.random.get_rng_state(), before)

    def test_codec(self) -> None:
        image, labels = load("disc", None, 4)
        assert labels is not None
        small, large = (convergence.codec("JPEG", row(bytes=size), image, labels) for size in (1_500, 6_000))
        assert small.bytes <= 1_500 and large.bytes <= 6_000 and small.psnr < large.psnr and not small.note
        assert small.n == 0 and small.decoded_psnr == small.psnr
        assert convergence.codec("JPEG", row(bytes=10), image, labels).note == "its smallest file is larger"


class TestAblation:
    def test_printed_figures_stand_beside_ours(self) -> None:
        rows = [row(p, method=m.name, psnr=20.0 + i) for p in "ab" for i, m in enumerate(ablation.PAPER_ROWS)]
        lines = ablation.paper_table(rows).splitlines()
        assert len(lines) == 2 + 6 and "| 20.00 | +0.00 | 19.00 | +0.00 |" in lines[2] and "27.10" in lines[2]
        assert "| 25.00 | +5.00 | 24.00 | +5.00 |" in lines[-1] and "27.31 | +0.21" in lines[-1]

    def test_conditions(self) -> None:
        conditions = {
            CLAMPED: (False, True),
            UNCLAMPED: (False, False),
            PAPER_CLAMPED: (True, True),
            PAPER: (True, False),
        }
        for method, switches in {**conditions, PAPER: (True, False)}.items():
            config = method.config()
            assert (config.guidance, config.clamp) == switches and config.iterations == 50_000
        switches = [(m.config().guidance, m.config().warmup, m.config().clamp) for m in ablation.PAPER_ROWS]
        assert len(set(switches)) == 6 and not BASELINE.config().guidance
        assert len({m.config() for m in ablation.OUR_ROWS}) == len(ablation.OUR_ROWS)
        assert set(ablation.PRINTED) == {m.name for m in ablation.PAPER_ROWS}


def test_complete_sequences_first() -> None:
    stages = davis._stages(["a", "b"], Options(budget_seconds=1.0))
    assert [(c.image, c.n) for c in stages[0]] == [("a", n) for n in (1_250, 7_500) for _ in davis.METHODS]
    assert {c.image for c in stages[1]} == {"b"} and {c.n for c in stages[2]} == {500}
    assert sum(map(len, stages)) == 2 * 6 * len(davis.METHODS)


@pytest.mark.parametrize("module", [charts, davis, ablation, convergence])
def test_quick(tmp_path: Path, module: Any) -> None:
    name = module.__name__.rpartition(".")[2]
    benchmarks.run(name, tmp_path, quick=True, sequences="disc" if module in (davis, ablation) else None)
    text = (tmp_path / "report.md").read_text()
    assert f"python -m benchmarks {name} -o DIR --quick" in text
    assert "nan" not in text.lower() and "Missing" not in text
    for link in text.split("![](")[1:]:
        assert (tmp_path / link.split(")")[0]).is_file()
    with (tmp_path / "results.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert all(float(line["bits_per_pixel"]) > 0 for line in lines)
    assert {m.name for m in module.METHODS} <= {line["method"] for line in lines}
    benchmarks.run(name, tmp_path, redraw=True)
    assert (tmp_path / "report.md").read_text() == text
