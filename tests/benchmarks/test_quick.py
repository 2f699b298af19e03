"""Every experiment in its quick form, and the committed reports."""

from __future__ import annotations

import json
import multiprocessing.dummy
import re
import shutil
from pathlib import Path

import pytest
import torch

import kcgs
from benchmarks.__main__ import EXPERIMENTS, main, module_of
from benchmarks.core.run import Options, read_rows, write_rows
from benchmarks.results import page
from kcgs.data import save_labels

# of which the quick form takes ten seconds
SLOW = ("pairs", "rate")
OF_A_GPU = ("gpu", "gpu-fit")
REPORTS = Path(kcgs.__file__).resolve().parent.parent / "benchmarks/reports"


@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")  # of pycocotools
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in EXPERIMENTS]
)
def test_quick_form(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.convergence.BUDGETS", (2, 60))
    if name in OF_A_GPU and not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    main([name, "-o", str(tmp_path), "--quick"])
    rows = read_rows(tmp_path / "results.csv")
    assert rows and all(row.keys() > {"image", "method"} for row in rows)
    report = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert report.startswith("# ") and "This is the short form" in report and "## Losses" in report
    assert f"`python -m benchmarks {name} -o DIR --quick`" in report and "nan" not in report
    figure = re.search(r"!\[\]\((.*)\)", report)
    assert figure is not None and (tmp_path / figure[1]).stat().st_size > 2_000
    # other codecs cannot go as low
    files = [row for row in rows if "target_bytes" in row and row["method"].startswith("kcgs")]
    assert all(row["bytes"] <= row["target_bytes"] for row in files)


@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")  # of pycocotools
def test_images_in_folders(tmp_path: Path) -> None:
    file = tmp_path / "data/DAVIS/Annotations/480p/dog/00000.png"
    file.parent.mkdir(parents=True)
    save_labels(file, torch.eye(16, dtype=torch.int64))
    main(["labels", "-o", str(tmp_path / "out"), "--data", str(tmp_path / "data")])
    assert {row["image"] for row in read_rows(tmp_path / "out/results.csv")} == {"DAVIS/Annotations/480p/dog/00000.png"}


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
@pytest.mark.parametrize("name", OF_A_GPU)
def test_no_gpu(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([name, "-o", str(tmp_path), "--quick"])
    assert "a benchmark of a GPU needs a CUDA device" in capsys.readouterr().err


@pytest.mark.parametrize("name", OF_A_GPU)
def test_a_cpu_in_place_of_a_gpu(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All but captures, counts of kernels and new processes, which need CUDA or seconds."""
    module, rows = module_of(name), []
    monkeypatch.setattr(module, "get_context", lambda _: multiprocessing.dummy, raising=False)
    monkeypatch.setattr("benchmarks.core.images.QUICK_STRIDE", 8)
    for job in module.jobs(Options(tmp_path, quick=True)):
        if job.get("task") not in ("captured", "kernels"):
            arguments = {**job, "device": "cpu", **({"method": "cpu"} if name == "gpu" else {})}
            rows += [{**row, "method": job["method"]} for row in module.measure(**arguments)]
    write_rows(tmp_path / "results.csv", rows)
    page = module.page(tmp_path, read_rows(tmp_path / "results.csv"))
    assert page.answer and page.table and "nan" not in page.answer + page.table + page.losses
    assert (tmp_path / page.figure).stat().st_size > 2_000


def test_errors(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, words in {
        ("none-such",): "invalid choice: 'none-such'",
        ("video",): "data must be a folder with images; got None",
        ("fill", "--data", str(tmp_path)): "data must have a folder with davis in it",
        ("render", "--quick", "--only", "W9"): "only must name some of W3, needles 1",
        ("zoo", "--only", "chart-3x2"): "only must name scenes of the zoo, chart-2x3",
    }.items():
        with pytest.raises(SystemExit):
            main([arguments[0], "-o", str(tmp_path / "out"), *arguments[1:]])
        assert words in capsys.readouterr().err
        assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("folder", [pytest.param(path, id=path.name) for path in sorted(REPORTS.iterdir())])
def test_committed_report_is_that_of_its_results(folder: Path, tmp_path: Path) -> None:
    assert folder.name in EXPERIMENTS
    shutil.copytree(folder, tmp_path / folder.name)
    report = tmp_path / folder.name / "report.md"
    report.unlink()
    main([folder.name, "-o", str(tmp_path / folder.name), "--redraw"])
    hint = f"python -m benchmarks {folder.name} -o benchmarks/reports/{folder.name} --redraw"
    assert report.read_text(encoding="utf-8") == (folder / "report.md").read_text(encoding="utf-8"), hint


def test_results_are_those_of_the_reports() -> None:
    hint = "python -m benchmarks.results"
    assert page() == (REPORTS.parent.parent / "docs/results.md").read_text(encoding="utf-8"), hint


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_jobs_on_data(name: str, data_root: Path) -> None:
    """The long form is not run here; its jobs are known, and JSON can hold them."""
    jobs = module_of(name).jobs(Options(Path("out"), data_root))
    assert len({json.dumps(job) for job in jobs}) == len(jobs) > 1
    assert all(isinstance(job["image"], str) for job in jobs)
