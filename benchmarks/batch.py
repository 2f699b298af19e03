"""How much faster are images fitted as a batch than one by one?"""

from __future__ import annotations

import os
import time
from functools import cache
from pathlib import Path
from statistics import median

import numpy as np
import torch
from torch import Tensor

from kcgs import FitConfig, fit
from kcgs.fitting import precompile

from .core.clocks import peak_megabytes, threads
from .core.cuda import megabytes, synchronize
from .core.figures import Panel, save_lines
from .core.fits import QUICK_ITERATIONS
from .core.goals import Goal, goals_table, missed_goals
from .core.images import choose, load, resize
from .core.run import Job, Options, Page, Row
from .core.tables import group_by, join_sections, means_table

KODAK = "Kodak"
# by size of crop: N, the factor by which photos are reduced, the batch sizes on one core, the batch sizes on a GPU
CASES: dict[str, tuple[int, int, tuple[int, ...], tuple[int, ...]]] = {
    "32 x 32": (64, 4, (1, 16, 128, 1024), (1, 64, 512, 4096)),
    "64 x 64": (128, 4, (1, 16, 64, 256), (1, 64, 512, 2048)),
    "128 x 128": (256, 2, (1, 4, 16, 64), (1, 16, 64, 512)),
    "256 x 256": (1000, 1, (1, 4, 16), (1, 16, 64, 256)),
    KODAK: (10_000, 1, (1, 24), (1, 24)),
}
QUICK_BATCHES = (1, 4)
CORE, GPU = "one core", "GPU"
# number of images that are fitted one by one; their mean time is reported
NUM_SINGLES = 8
ROUNDS = 3
# factor against fits one by one, on one core
GOALS_OF_A_CORE = {"32 x 32": 6.0, "64 x 64": 3.0, "128 x 128": 1.2}
# images per second on an H100 or H200
GOALS_OF_A_GPU = {"32 x 32": 4000.0, "64 x 64": 1200.0, "128 x 128": 300.0, "256 x 256": 60.0, KODAK: 4.0}
# largest difference of PSNR between an image in a batch and the image alone, in dB
MOST_DIFFERENCE = 0.02
METHOD = f"""Crops of photos of Kodak that are reduced by area: to a quarter of their sides for crops of 32 and 64
pixels, to half for 128; and the 24 photos as they are, upright ones turned. `fit(images, None, N)` with its default
settings. A batch of 1 is one by one, of {NUM_SINGLES} images. Medians of {ROUNDS} turns, all sizes of batches in each;
of the photos one turn. Images per second are those of the call, on one core or on a GPU, without compilation. PSNR is
the mean over the images that were also fitted one by one, and *difference* the largest of one of them. MB is what a fit
adds at the peak."""


@cache
def crops(case: str, count: int, data: str, quick: bool) -> Tensor:
    """Cut `count` crops of a case from reduced photos, (B, 3, S, S); one photo may give several crops."""
    names = choose(Options(Path(), Path(data) if data else None, quick), "kodak")
    if case == KODAK:
        photos = [load(name, data, quick).image for name in names]
        size = photos[0].shape
        return torch.stack([photo if photo.shape == size else photo.mT for photo in photos[:count]]).contiguous()
    side, reduction = int(case.split()[0]), CASES[case][1]
    images = []
    for k in range(count):
        photo = reduced(names[k % len(names)], data, quick, reduction, side)
        rng = np.random.default_rng(k)
        y, x = (int(rng.integers(0, length - side + 1)) for length in photo.shape[1:])
        images.append(photo[:, y : y + side, x : x + side])
    return torch.stack(images)


@cache
def reduced(name: str, data: str, quick: bool, reduction: int, side: int) -> Tensor:
    """Reduce a photo by area; each side keeps at least `side` pixels."""
    photo = load(name, data, quick).image
    height, width = (max(side, length // reduction) for length in photo.shape[1:])
    return resize(photo, (height, width), "box")


def fit_all(images: Tensor, n: int, config: FitConfig, together: bool) -> Tensor:
    """Fit images together or one by one; return the PSNR of each."""
    batches = [images] if together else images.split(1)
    results = [fit(batch, None, n, recipe=config) for batch in batches]
    synchronize()
    return torch.cat([torch.as_tensor(result.psnr) for result in results])


def fit_by_name(case: str, batch: int, data: str, config: FitConfig) -> None:
    """Fit a batch in a process whose memory is measured."""
    fit_all(crops(case, batch, data, quick=False), CASES[case][0], config, together=True)


def measure(image: str, method: str, batches: list[int], data: str, quick: bool) -> list[Row]:
    """Time the batches of a case in turns, and compare their PSNR with fits one by one."""
    n, device = (20 if quick else CASES[image][0]), "cuda" if method == GPU else "cpu"
    config = FitConfig(iterations=QUICK_ITERATIONS if quick else None)
    singles = min(NUM_SINGLES, max(batches))
    images = {batch: crops(image, singles if batch == 1 else batch, data, quick).to(device) for batch in batches}
    seconds: dict[int, list[float]] = {batch: [] for batch in batches}
    psnrs: dict[int, Tensor] = {}
    with threads(1 if method == CORE else os.cpu_count() or 1):
        precompile(config, device)
        for _ in range(1 if quick or image == KODAK else ROUNDS + 1):  # the first round compiles
            for batch in batches:
                start = time.perf_counter()
                psnrs[batch] = fit_all(images[batch], n, config, together=batch > 1)
                seconds[batch].append((time.perf_counter() - start) / len(images[batch]))
    alone = psnrs[1]
    rows = []
    for batch in batches:
        count = min(len(psnrs[batch]), len(alone))
        times = seconds[batch][1:] or seconds[batch]
        rows.append(
            {
                "image": image, "method": method, "n": n, "batch": batch, "images_per_second": 1 / median(times),
                "psnr": float(psnrs[batch][:count].mean()),
                "difference": float((psnrs[batch][:count] - alone[:count]).abs().max()),
            }
        )  # fmt: skip
    largest = max(batches)
    if method == GPU:
        rows[-1]["peak_MB"] = megabytes(lambda: fit_all(images[largest], n, config, together=True))
    elif not quick:
        rows[-1]["peak_MB"] = peak_megabytes(
            fit_by_name, image, largest, data, config, warm_up=(image, 2, data, config)
        )
    return rows


def jobs(options: Options) -> list[Job]:
    """List all cases on one core, and on a GPU if there is one."""
    devices = [CORE, *([GPU] if torch.cuda.is_available() else [])]
    cases = [name for name in CASES if not options.quick or name == "32 x 32"]
    if options.data is None:
        cases = [name for name in cases if name != KODAK]
    return [
        {
            "image": name, "method": method, **options.image_arguments(),
            "batches": QUICK_BATCHES if options.quick else CASES[name][2 if method == CORE else 3],
        }
        for method in devices
        for name in cases
    ]  # fmt: skip


def page(folder: Path, rows: list[Row]) -> Page:
    """Write the report."""
    one_by_one = {(row["image"], row["method"]): row["images_per_second"] for row in rows if row["batch"] == 1}
    for row in rows:
        row["times as fast"] = row["images_per_second"] / one_by_one[row["image"], row["method"]]
    panels = [
        Panel(str(method), group, "batch", "images_per_second", ("log", "log"))
        for (method,), group in group_by(rows, ["method"]).items()
    ]
    save_lines(folder / "batch.png", panels, "image", "batch")
    groups = group_by(rows, ["method", "image"]).values()
    best = [max(group, key=lambda row: row["images_per_second"]) for group in groups]
    sentences = [
        f"{row['image']}, N = {row['n']:,}, on {row['method']}: {row['images_per_second']:.3g} images per second in "
        f"batches of {row['batch']:,}, {row['times as fast']:.1f} times as many as one by one."
        for row in best
    ]
    goals = []
    for row in best:
        name, is_core = f"{row['image']}, {row['method']}", row["method"] == CORE
        quantity, limits = ("times as fast", GOALS_OF_A_CORE) if is_core else ("images_per_second", GOALS_OF_A_GPU)
        if row["image"] in limits:
            goals.append(Goal(name, quantity, limits[row["image"]], row[quantity], more_is_better=True))
        worst = max(
            other["difference"] for other in rows if (other["image"], other["method"]) == (row["image"], row["method"])
        )
        goals.append(Goal(name, "difference", MOST_DIFFERENCE, worst))
    columns = ("images_per_second", "times as fast", "psnr", "difference", "peak_MB")
    table = means_table(rows, ["method", "image", "n", "batch"], "", columns)
    has_gpu = any(row["method"] == GPU for row in rows)
    missing = "" if has_gpu else "No GPU was measured: that takes a CUDA device."
    losses = join_sections(missed_goals(goals), missing)
    return Page(" ".join(sentences), "batch.png", join_sections(table, goals_table(goals)), losses, METHOD)
