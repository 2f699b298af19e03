"""Peak memory of what reads files: at most six bytes per pixel beyond its result, measured in a process of its own."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image

from kcgs import GaussianField, RegionMap, Scene
from kcgs.codec import encode
from kcgs.codec.file import varint
from kcgs.codec.labels.stream import encode_stream

from .codec.test_hostile import forge_map
from .codec.test_label_files import DTYPES

SIDE = 3000
SLACK = 12_000_000  # bytes
PER_PIXEL = 6  # bytes
PROGRAM = """
import re, sys, warnings
import kcgs, torch
from kcgs._image import as_image
from kcgs.codec import decode_labels
from kcgs.data import load_image, load_labels
from kcgs.maps import touching_pairs

def read(path, side):
    return {read}

def memory(name):  # the peak of getrusage is at least that of the parent process
    with open("/proc/self/status") as status:
        return 1024 * int(re.search(name + r":\\s+(\\d+)", status.read())[1])

warnings.simplefilter("ignore")
read(sys.argv[1], 64)  # loads modules
before = memory("VmRSS")
result = read(sys.argv[2], int(sys.argv[3]))
print(memory("VmHWM") - before)
"""


def labels(side: int) -> np.ndarray:
    """Return four rectangles."""
    half = np.arange(side) > side // 3
    return half[:, None] + 2 * half


def colors(side: int, channels: int) -> np.ndarray:
    return (40 * labels(side)[..., None] + np.arange(channels)).astype(np.uint8)


def write_nothing(path: Path, side: int) -> None:
    pass


def write_png(channels: int) -> Callable[[Path, int], None]:
    return lambda path, side: Image.fromarray(colors(side, channels)).save(path, "PNG", compress_level=1)


def write_tiff(path: Path, side: int) -> None:
    tifffile.imwrite(path, colors(side, 3).astype(np.uint16), photometric="rgb")


def write_npy(path: Path, side: int) -> None:
    np.save(path, labels(side))


def write_map(path: Path, side: int) -> None:
    """Write a transposed map of int32."""
    ids, index = np.unique(labels(side), return_inverse=True)
    stream = encode_stream(ids, index.reshape(side, side).astype(np.int32), is_file=True)
    path.write_bytes(forge_map(4 + 8 * DTYPES.index(torch.int32), 2 * varint(side), stream))


def write_scene(factor: int) -> Callable[[Path, int], None]:
    def write(path: Path, side: int) -> None:
        regions = torch.from_numpy(labels(side) * factor)
        field = GaussianField.random(9, (side, side), regions=regions, seed=0)
        path.write_bytes(encode(Scene(field, RegionMap.from_labels(regions))))

    return write


# what is written, how it is read, and the bytes per pixel of the result
CASES: dict[str, tuple[Callable[[Path, int], None], str, int]] = {
    "RGB as L": (write_png(3), "load_image(path, channels='L')", 4),
    "RGBA as RGB": (write_png(4), "load_image(path)", 12),
    "TIFF": (write_tiff, "load_image(path)", 12),
    "tensor": (write_nothing, "as_image('image', torch.zeros(3, side, side))", 12),
    "colours": (write_png(3), "load_labels(path)", 8),
    "colours that are ids": (write_png(3), "load_labels(path, rgb_ids=True)", 8),
    "array": (write_npy, "load_labels(path)", 8),
    "map": (write_map, "decode_labels(open(path, 'rb').read())", 4),
    "scene": (write_scene(1), "kcgs.load(path)", 12),
    "scene of large ids": (write_scene(100_000), "kcgs.load(path)", 12),
    "contours": (write_nothing, "touching_pairs((torch.arange(side) % 3).repeat(side, 1))", 8),
}


@pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="the peak is read from /proc")
@pytest.mark.parametrize("case", CASES)
def test_peak(case: str, tmp_path: Path) -> None:
    write, read, result_bytes = CASES[case]
    suffix = ".npy" if write is write_npy else ".kcgs"  # of images and maps the content counts
    paths = [tmp_path / f"{side}{suffix}" for side in (64, SIDE)]
    write(paths[0], 64)
    write(paths[1], SIDE)
    command = [sys.executable, "-W", "ignore", "-c", PROGRAM.format(read=read), *paths, str(SIDE)]
    run = subprocess.run(command, check=True, capture_output=True, text=True)
    assert int(run.stdout) < (result_bytes + PER_PIXEL) * SIDE**2 + SLACK
