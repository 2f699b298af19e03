"""Every experiment in its quick form, and the committed reports."""

from __future__ import annotations

import json
import shutil
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

import kcgs
from benchmarks.__main__ import NAMES, main
from benchmarks.core.run import Options, read_rows

ROOT = Path(kcgs.__file__).resolve().parent.parent
REPORTS = ROOT / "benchmarks/reports"
FIGURES = {"fill": "fill.jpg"}
# what a row of each has at least
COLUMNS = {
    "quality": {"psnr", "ef_psnr", "decoded_psnr", "bytes", "core_seconds"},
    "ablation": {"psnr", "ef_psnr"},
    "convergence": {"core_seconds", "psnr"},
    "maps": {"source", "psnr", "decoded_psnr", "regions"},
    "rate": {"asked", "bytes", "psnr"},
    "labels": {"bytes", "encode_speed", "decode_speed"},
    "render": {"threads", "cutoff"},
    "decode": {"ms", "error"},
    "enlarge": {"factor", "psnr", "ms"},
    "fill": {"edit", "steep", "added"},
}


@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")  # of pycocotools
@pytest.mark.parametrize("name", COLUMNS)
def test_quick_form(name: str, tmp_path: Path) -> None:
    main([name, "-o", str(tmp_path), "--quick"])
    rows = read_rows(tmp_path / "results.csv")
    assert rows and all(row.keys() >= {"image", "method"} for row in rows)
    assert all(COLUMNS[name] <= row.keys() for row in rows[:1])
    report = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert report.startswith("# ") and "This is the short form" in report and "## Losses" in report
    assert f"`python -m benchmarks {name} -o DIR --quick`" in report and "nan" not in report
    assert (tmp_path / FIGURES.get(name, f"{name}.png")).stat().st_size > 2_000
    # files that asked for bytes have no more of them, but where a codec cannot go as low
    assert all(row["bytes"] <= row["asked"] for row in rows if "asked" in row and row["method"].startswith("kcgs"))


def test_errors(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, words in {
        ("none-such",): "invalid choice: 'none-such'",
        ("maps",): "data must be a folder with images; got None",
        ("fill", "--data", str(tmp_path)): "data must have a folder with davis in it",
        ("render", "--quick", "--only", "W9"): "only must name some of W3, needles 1",
        ("zoo", "--only", "chart-3x2"): "only must name scenes of the zoo, chart-2x3",
    }.items():
        with pytest.raises(SystemExit):
            main([arguments[0], "-o", str(tmp_path / "out"), *arguments[1:]])
        assert words in capsys.readouterr().err
        assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", COLUMNS)
def test_committed_report_is_that_of_its_results(name: str, tmp_path: Path) -> None:
    shutil.copytree(REPORTS / name, tmp_path / name)
    report = tmp_path / name / "report.md"
    report.unlink()
    main([name, "-o", str(tmp_path / name), "--redraw"])
    hint = f"python -m benchmarks {name} -o benchmarks/reports/{name} --redraw"
    assert report.read_text(encoding="utf-8") == (REPORTS / name / "report.md").read_text(encoding="utf-8"), hint


def test_reports_have_every_experiment() -> None:
    assert {*COLUMNS, "zoo"} == {*NAMES}
    assert {path.name for path in REPORTS.iterdir()} == COLUMNS.keys()


@pytest.mark.parametrize("name", COLUMNS)
def test_jobs_on_data(name: str, data_root: Path) -> None:
    """The long form is not run here; its jobs are known, and JSON can hold them."""
    jobs: list[dict[str, Any]] = import_module(f"benchmarks.{name}").jobs(Options(Path("out"), data_root))
    assert len({json.dumps(job) for job in jobs}) == len(jobs) > 4
    assert all(isinstance(job["image"], str) for job in jobs)
