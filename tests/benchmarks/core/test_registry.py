"""Experiments by name, their options, and reports written again from kept results."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

import benchmarks
import kcgs
from benchmarks.core.options import Options

REPORTS = Path(kcgs.__file__).resolve().parent.parent / "benchmarks/reports"
NAMES = ("ablation", "charts", "convergence", "davis", "decode", "enlarge", "fill", "labels", "maps", "rate", "render")


def test_names() -> None:
    with pytest.raises(ValueError, match="name must be one of .*; got 'core'"):
        benchmarks.run("core", Path())


def test_wrong_questions(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="seeds must not be given to maps, whose options are data, quick, engine"):
        benchmarks.run("maps", tmp_path / "out", seeds=2)
    with pytest.raises(ValueError, match="workers must not be given to rate"):
        benchmarks.run("rate", tmp_path / "out", workers=2)
    assert not (tmp_path / "out").exists()
    with pytest.raises(ValueError, match="sequences must not be given to charts"):
        benchmarks.run("charts", tmp_path, quick=True, sequences="dog")
    with pytest.raises(ValueError, match="budget_seconds must be above 0; got -1"):
        benchmarks.run("davis", tmp_path, quick=True, budget_seconds=-1)
    with pytest.raises(FileNotFoundError, match=r"made\.json"):
        benchmarks.run("charts", tmp_path, redraw=True)


def test_command() -> None:
    options = Options(data=Path("x"), quick=True, sequences="dog", budget_seconds=8300, seeds=2, runs=Path("y"))
    words = "--data DIR --quick --sequences dog --budget-seconds 8300 --seeds 2 --runs DIR"
    assert options.command("davis") == f"python -m benchmarks davis -o DIR {words}"


@pytest.mark.parametrize("name", NAMES)
def test_committed_reports_are_written_from_their_results(tmp_path: Path, name: str) -> None:
    if not REPORTS.is_dir():
        pytest.skip("not a source checkout")
    output = tmp_path / name
    shutil.copytree(REPORTS / name, output)
    (output / "report.md").unlink()
    benchmarks.run(name, output, redraw=True)
    assert (output / "report.md").read_text() == (REPORTS / name / "report.md").read_text(), (
        "python -m benchmarks NAME --redraw"
    )
