"""What docs/results.md says is what the committed results.csv files say."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import kcgs
from benchmarks.core.pages import BEGIN, END, put, results
from benchmarks.core.rows import read_rows, write_rows
from benchmarks.core.store import Row

ROOT = Path(kcgs.__file__).resolve().parent.parent
REPORTS = ROOT / "benchmarks/reports"


def row(method: str, psnr: float, image: str = "pie") -> Row:
    figures = {"psnr": psnr, "ms_ssim": 0.9, "ef_psnr": 31.2, "ef_ssim": 0.8}
    decoded: dict[str, Any] = {f"decoded_{name}": value for name, value in figures.items()}
    return Row(
        image=image, n=20, method=method, seed=0, iterations=700, seconds=3.0, core_seconds=2.0, num_gaussians=20,
        pixels=16_000, bytes=100, map_bytes=10, **figures, **decoded, ssimulacra2=40.0, butteraugli=2.0,
    )  # fmt: skip


def test_results_are_those_of_the_reports() -> None:
    if not REPORTS.is_dir():
        pytest.skip("not a source checkout")
    page = (ROOT / "docs/results.md").read_text(encoding="utf-8")
    assert put(page, results(REPORTS)) == page, "make report, or python -m benchmarks.core.pages"


def test_a_changed_figure_shows(tmp_path: Path) -> None:
    rows = [row("best", 38.6), row("paper", 30.0)]
    (tmp_path / "charts").mkdir()
    write_rows(tmp_path / "charts/results.csv", Row, rows)
    assert read_rows(tmp_path / "charts/results.csv", Row) == rows
    text = results(tmp_path)
    assert "| 20 | `best` | 700 | 1 | 20 | 38.60 | 31.20 | 0.050 | 38.60 | 2 |" in text
    assert put(f"a\n{BEGIN}\nold\n{END}\nb", text) == f"a\n{BEGIN}\n{text}\n{END}\nb"
    with pytest.raises(ValueError, match="page must have"):
        put("nothing", text)


def test_differences_are_paired(tmp_path: Path) -> None:
    (tmp_path / "davis").mkdir()
    gains = {"a": 0.1, "b": 0.2, "c": 0.3, "d": 0.2, "e": 0.2}
    rows = [row(m, 30.0 + g * (m == "best"), p) for p, g in gains.items() for m in ("best", "paper")]
    write_rows(tmp_path / "davis/results.csv", Row, rows)
    text = results(tmp_path)
    assert "| 20 | best - paper | equal N | 5 | +0.20 | +0.10 to +0.30 | 5-0 | +0.00 |" in text
