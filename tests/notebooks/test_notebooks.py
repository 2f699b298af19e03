"""The tutorials: each runs in its quick form, and what is committed is a whole run of its full form."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

import kcgs

FOLDER = Path(kcgs.__file__).resolve().parent.parent / "notebooks"
SCRIPT = FOLDER / "execute.py"
if not SCRIPT.is_file():
    pytest.skip("the tutorials come with a checkout", allow_module_level=True)
nbformat = pytest.importorskip("nbformat", reason="the tutorials run with the extra 'notebooks'")

# of each, a result that it prints
PRINTED = {
    "01_fit_a_photo": r"\d+ Gaussians, \d+ regions: PSNR [23]\d\.\d\d dB",
    "02_why_contours": r"\d+ Gaussians: contours add \+\d\.\d\d dB PSNR, \+\d\.\d\d dB EF-PSNR",
    "03_label_maps": r"auto: [23]\d\.\d\d dB, \+\d\.\d\d dB for +\d[\d,]* bytes",
    "04_edit_by_region": r"\d+ % of the pixels have no share in the suit; all are unchanged",
    "05_export_to_onnx": r"largest difference of a value in \[0, 1\]: \d\.\de-0[4-9]",
    "06_differentiable_layer": r"after: loss 0\.\d+, PSNR +[12]\d\.\d\d dB",
    "07_compact_files": r"kcgs: +\d[\d,]* bytes, PSNR [23]\d\.\d\d dB, EF-PSNR [23]\d\.\d\d dB",
    "08_video": r"\d+ frames: [23]\d\.\d\d dB at first, [23]\d\.\d\d dB at last",
    "09_kornia_augmentation": r"mean of sixteen: 2\d\.\d\d dB; render: 2\d\.\d\d dB",
    "10_train_on_gaussians": r"Gaussians: \d\d\.\d% of the digits in \d+ epochs",
}
# a kernel takes ten seconds for what it imports, and most take half a minute in their quick form: all run before a
# release, by `make test-all`
SLOW = PRINTED.keys() - {"01_fit_a_photo", "09_kornia_augmentation"}
BYTES = 2_700_000


def read(path: Path) -> Any:
    return nbformat.read(path, as_version=4)


def run_quick(name: str, folder: Path) -> Any:
    """Return a notebook with the outputs of its quick form."""
    command = [sys.executable, str(SCRIPT), "--quick", "-o", str(folder), str(FOLDER / f"{name}.ipynb")]
    run = subprocess.run(command, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    return read(folder / f"{name}.ipynb")


@pytest.fixture(scope="module")
def quick(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Future[Any]]]:
    """Run all, two at a time unless tests do: a kernel takes one thread, and seconds to import what it needs."""
    folder = tmp_path_factory.mktemp("quick")
    with ThreadPoolExecutor(1 if "PYTEST_XDIST_WORKER" in os.environ else 2) as pool:
        item_names = {item.name for item in request.session.items}
        notebooks = [name for name in PRINTED if f"test_runs[{name}]" in item_names]
        yield {name: pool.submit(run_quick, name, folder) for name in notebooks}
        pool.shutdown(cancel_futures=True)


def outputs_of(notebook: Any) -> list[Any]:
    return [output for cell in notebook.cells for output in cell.get("outputs", [])]


def assert_clean(notebook: Any) -> None:
    """Text on standard output and images: no error, no warning, nothing that names a place on a machine."""
    for output in outputs_of(notebook):
        if output.output_type == "stream":
            assert output.name == "stdout", output.text
            text = output.text
        else:
            assert output.output_type == "display_data", output
            assert set(output.data) in ({"image/png", "text/plain"}, {"image/jpeg", "text/plain"})
            text = output.data["text/plain"]
        assert not re.search(r"warning|/(work|tmp|root|home|Users)\b", text, re.IGNORECASE), text


def assert_prints(name: str, notebook: Any) -> None:
    text = "".join(output.text for output in outputs_of(notebook) if output.output_type == "stream")
    assert re.search(PRINTED[name], text), text


def test_all_are_here() -> None:
    assert sorted(path.stem for path in FOLDER.glob("*.ipynb")) == list(PRINTED)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in PRINTED]
)
def test_runs(name: str, quick: dict[str, Future[Any]]) -> None:
    """In its quick form; what it claims it asserts itself."""
    notebook = quick[name].result()
    assert_clean(notebook)
    assert_prints(name, notebook)


class TestCommitted:
    @pytest.mark.parametrize("name", PRINTED)
    def test_is_a_run_from_top_to_bottom(self, name: str) -> None:
        notebook = read(FOLDER / f"{name}.ipynb")
        nbformat.validate(notebook)
        cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
        assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
        for cell in cells:
            output_types = {output.output_type for output in cell.outputs}
            # a helper's own body is indented and shows nothing until it is called
            assert ("stream" in output_types) == bool(re.search(r"^( {4})?print\(", cell.source, re.MULTILINE)), (
                cell.source
            )
            assert ("display_data" in output_types) == bool(
                re.search(r"^(show(_rows)?\(|\w.*= plt\.subplots\()", cell.source, re.MULTILINE)
            ), cell.source
        assert_clean(notebook)
        assert_prints(name, notebook)

    @pytest.mark.parametrize("name", PRINTED)
    def test_holds_no_more_than_its_run(self, name: str) -> None:
        """No versions, timestamps or names of kernels that differ from machine to machine."""
        notebook = read(FOLDER / f"{name}.ipynb")
        assert notebook.metadata == {
            "kernelspec": {"display_name": "python3", "language": "python", "name": "python3"},
            "language_info": {"name": "python"},
        }
        assert not any(cell.metadata for cell in notebook.cells)

    def test_small(self) -> None:
        assert sum(path.stat().st_size for path in FOLDER.glob("*.ipynb")) < BYTES


def test_quick_form_is_not_written_in_place() -> None:
    run = subprocess.run([sys.executable, str(SCRIPT), "--quick"], capture_output=True, text=True)
    assert run.returncode == 2 and "needs -o" in run.stderr
