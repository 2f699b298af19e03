"""Run the tutorials from top to bottom and keep what they print and show.

All of them in full, in place; with ``--quick -o FOLDER``, the short form that the tests run, written elsewhere.
"""

from __future__ import annotations

import argparse
import base64
import io
import os
import tempfile
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbformat import NotebookNode
from PIL import Image

FOLDER = Path(__file__).resolve().parent
# one thread: the images are then the same, bit for bit, on every run
_ENVIRONMENT = {"OMP_NUM_THREADS": "1", "MPLBACKEND": "module://matplotlib_inline.backend_inline"}


def notebooks() -> list[Path]:
    """Return the tutorials in the order to read them."""
    return sorted(FOLDER.glob("*.ipynb"))


def execute(path: Path, *, quick: bool, timeout: float = 600.0) -> NotebookNode:
    """Run a notebook in a kernel and a folder of its own, and return it with its outputs.

    Args:
        path: the notebook; the file is not changed.
        quick: smaller images and shorter fits, as the tests run it.
        timeout: seconds that a cell, or the kernel's start, may take.

    Raises:
        CellExecutionError: a cell raised an error.
        CellTimeoutError: a cell took too long.
    """
    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        client = NotebookClient(
            notebook,
            timeout=timeout,
            startup_timeout=timeout,
            kernel_name="python3",
            record_timing=False,
            resources={"metadata": {"path": folder}},
            extra_arguments=["--IPKernelApp.log_level=ERROR"],
        )
        # the notebook imports `show.py`, as it does where it lies
        python_path = os.pathsep.join(filter(None, [str(FOLDER), os.environ.get("PYTHONPATH")]))
        settings = {"KCGS_QUICK": str(int(quick)), "IPYTHONDIR": folder, "PYTHONPATH": python_path}
        client.execute(env={**os.environ, **_ENVIRONMENT, **settings})
    _drop_what_varies(notebook)
    for cell in notebook.cells:
        for output in cell.get("outputs", []):
            _shrink(output.get("data", {}))
    return notebook


def _drop_what_varies(notebook: NotebookNode) -> None:
    """Leave no versions, timestamps or local names of kernels in the file."""
    notebook.metadata = {
        "kernelspec": {"display_name": "python3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    for cell in notebook.cells:
        cell.metadata = {}


def _shrink(data: dict[str, str]) -> None:
    """Keep a photo as JPEG, in which it takes a fraction of the bytes; plots stay PNG."""
    if "image/png" not in data:
        return
    content, file = base64.b64decode(data["image/png"]), io.BytesIO()
    Image.open(io.BytesIO(content)).convert("RGB").save(file, "jpeg", quality=92, subsampling=0, optimize=True)
    if file.tell() < 0.7 * len(content):
        data["image/jpeg"] = base64.b64encode(file.getvalue()).decode()
        del data["image/png"]


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("paths", type=Path, nargs="*", help="notebooks; default: all")
    parser.add_argument("--quick", action="store_true", help="smaller images and shorter fits, as the tests run them")
    parser.add_argument("-o", "--output", type=Path, help="folder to write to; default: in place")
    args = parser.parse_args()
    if args.quick and args.output is None:
        parser.error("--quick needs -o: what is kept here is the full form")
    for path in args.paths or notebooks():
        start = time.perf_counter()
        notebook = execute(path, quick=args.quick)
        nbformat.write(notebook, path if args.output is None else args.output / path.name)
        print(f"{path.name}: {time.perf_counter() - start:.1f} s")


if __name__ == "__main__":
    main()
