"""The Triton kernels against their references, on a GPU or in Triton's interpreter, in a process of their own.

TRITON_INTERPRET is read when triton is imported, so it must not be set in the process of the other tests.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

FOLDER = Path(__file__).parent
FILES = ("kernels/triton_cases.py", "optim/triton_steps.py", "fitting/triton_filters.py")


@pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="Triton is not installed: pip install triton")
def test_agree_with_their_references() -> None:
    environment = {k: v for k, v in os.environ.items() if k != "TRITON_INTERPRET"}
    if not torch.cuda.is_available():
        environment |= {"TRITON_INTERPRET": "1", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *(str(FOLDER / name) for name in FILES)]
    done = subprocess.run(command, env=environment, cwd=FOLDER.parent, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert " passed" in done.stdout, done.stdout
    assert not torch.cuda.is_available() or "skipped" not in done.stdout, done.stdout
