"""Errors as the eye sees them: SSIMULACRA2 and butteraugli, where this machine can measure them."""

from __future__ import annotations

import math
import re
import shutil
import subprocess
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple, TypeVar

from torch import Tensor

from kcgs._repr import png
from kcgs.evaluation import ssimulacra2

Record = TypeVar("Record", bound=NamedTuple)
PROGRAM = "butteraugli_main"


def butteraugli(render: Tensor, image: Tensor) -> float:
    """Measure the 3-norm of butteraugli's differences by libjxl's program; below 1 few people see any."""
    with TemporaryDirectory() as folder:
        paths = [Path(folder, name) for name in ("image.png", "render.png")]
        for path, shown in zip(paths, (image, render), strict=True):
            path.write_bytes(png(shown) or b"")
        done = subprocess.run([PROGRAM, *paths], capture_output=True, text=True, check=False)
    found = re.search(r"^3-norm: ([0-9.]+)", done.stdout, re.MULTILINE)
    if found is None:
        raise RuntimeError(f"{PROGRAM} must print '3-norm: NUMBER'; got {done.stdout + done.stderr!r}")
    return float(found[1])


# the fields of records that `look` fills in
MEASURES = {"ssimulacra2": ssimulacra2, "butteraugli": butteraugli}


def look(record: Record, images: Callable[[], tuple[Tensor, Tensor]]) -> Record:
    """Fill in what a record has not and this machine can measure of render and image; the record itself: nothing."""
    tools = {"ssimulacra2": find_spec("ssimulacra2"), "butteraugli": shutil.which(PROGRAM)}
    todo = [name for name, tool in tools.items() if tool and math.isnan(getattr(record, name))]
    if not todo:
        return record
    render, image = images()
    return record._replace(**{name: MEASURES[name](render, image) for name in todo})
