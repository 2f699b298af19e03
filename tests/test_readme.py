"""What README.md says of results is what the committed results.csv files say."""

from __future__ import annotations

from pathlib import Path

import pytest

import kcgs
from kcgs.bench.paper.readme import BEGIN, END, put, results

ROOT = Path(kcgs.__file__).resolve().parent.parent
REPORTS = ROOT / "notebooks/reports"


def test_results_are_those_of_the_reports() -> None:
    if not REPORTS.is_dir():
        pytest.skip("not a source checkout")
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert put(readme, results(REPORTS)) == readme, "make report, or python -m kcgs.bench.paper.readme"


def test_a_changed_figure_shows(tmp_path: Path) -> None:
    (tmp_path / "charts").mkdir()
    head = "picture,n,method,iterations,psnr,ef_psnr,bits_per_pixel,decoded_psnr\n"
    (tmp_path / "charts/results.csv").write_text(
        head + "pie,20,best,700,38.6,31.2,0.05,38.5\npie,20,paper,5000,30.0,25.0,0.04,29.9\n"
    )
    text = results(tmp_path)
    assert "| 20 | `best` | 700 | 1 | 38.60 | 31.20 | 0.050 | 38.50 |" in text
    assert put(f"a\n{BEGIN}\nold\n{END}\nb", text) == f"a\n{BEGIN}\n{text}\n{END}\nb"
    with pytest.raises(ValueError, match="README must have"):
        put("nothing", text)
