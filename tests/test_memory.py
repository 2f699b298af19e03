"""Peak memory of what reads files: at most six bytes per pixel beyond its result, measured in forks of one process."""

from __future__ import annotations

import json
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

SIDE = 1200
SLACK = 2_000_000  # bytes
PER_PIXEL = 6  # bytes
# reads each case in a copy of one process that has loaded everything: a peak is that of a copy alone
PROGRAM = """
import json, os, re, sys, warnings
import kcgs, torch
from kcgs.codec import decode_labels
from kcgs.data import load_image, load_labels

def memory(name):  # the peak of getrusage is at least that of the parent process
    with open("/proc/self/status") as status:
        return 1024 * int(re.search(name + r":\\s+(\\d+)", status.read())[1])

def measure(read, small, large):
    read = eval(f"lambda path: {read}")
    read(small)  # loads modules
    before = memory("VmRSS")
    result = read(large)
    print(memory("VmHWM") - before, flush=True)

warnings.simplefilter("ignore")
torch.set_num_threads(1)
for case in json.load(sys.stdin):
    if (child := os.fork()) == 0:
        measure(*case)
        os._exit(0)
    if os.waitpid(child, 0)[1]:
        sys.exit(1)
"""


def labels(side: int) -> np.ndarray:
    """Return four rectangles."""
    half = np.arange(side) > side // 3
    return half[:, None] + 2 * half


def colors(side: int, channels: int) -> np.ndarray:
    return (40 * labels(side)[..., None] + np.arange(channels)).astype(np.uint8)


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


def write_scene(path: Path, side: int) -> None:
    regions = torch.from_numpy(labels(side) * 100_000)
    field = GaussianField.random(9, (side, side), regions=regions, seed=0)
    path.write_bytes(encode(Scene(field, RegionMap(regions))))


# what is written, how it is read, and the bytes per pixel of the result
CASES: dict[str, tuple[Callable[[Path, int], None], str, int]] = {
    "RGBA as RGB": (write_png(4), "load_image(path)", 12),
    "TIFF": (write_tiff, "load_image(path)", 12),
    "colours": (write_png(3), "load_labels(path)", 8),
    "colours that are ids": (write_png(3), "load_labels(path, rgb_ids=True)", 8),
    "array": (write_npy, "load_labels(path)", 8),
    "map": (write_map, "decode_labels(open(path, 'rb').read())", 4),
    "scene": (write_scene, "kcgs.load(path)", 12),
}


@pytest.fixture(scope="module")
def peaks(tmp_path_factory: pytest.TempPathFactory) -> dict[str, int]:
    """What reading a file adds to the peak of memory, in bytes."""
    cases = []
    for write, read, _ in CASES.values():
        suffix = ".npy" if write is write_npy else ".kcgs"  # of images and maps the content counts
        paths = [tmp_path_factory.mktemp("case") / f"{side}{suffix}" for side in (64, SIDE)]
        write(paths[0], 64)
        write(paths[1], SIDE)
        cases.append((read, *map(str, paths)))
    command = [sys.executable, "-W", "ignore", "-c", PROGRAM]
    run = subprocess.run(command, check=True, capture_output=True, text=True, input=json.dumps(cases))
    return dict(zip(CASES, map(int, run.stdout.split()), strict=True))


@pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="the peak is read from /proc")
@pytest.mark.parametrize("case", CASES)
def test_peak(case: str, peaks: dict[str, int]) -> None:
    assert 0 < peaks[case] < (CASES[case][2] + PER_PIXEL) * SIDE**2 + SLACK
