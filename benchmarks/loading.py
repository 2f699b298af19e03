"""How fast do scenes come from a data set, beside images from files?"""

from __future__ import annotations

import time
from io import BytesIO
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from kcgs import GaussianField, Scene
from kcgs.data import SceneDataset, save_shard

from .batch import crops
from .core.clocks import threads
from .core.figures import Panel, save_lines
from .core.goals import Goal, goals_table, missed_goals
from .core.run import Job, Options, Page, Row
from .core.tables import join_sections, means_table

SHARDS, PNG, JPEG = "shards of Gaussians", "PNG", "JPEG"
# number of Gaussians of a scene, by the size of its image
SIDES = {"32 x 32": 64, "128 x 128": 256}
NUM_IMAGES = 4096
QUICK_IMAGES = 64
BATCH = 64
ROUNDS = 5
QUALITY = 90
# factor against decoding JPEG
GOAL = 5.0
METHOD = f"""A shuffled DataLoader in this process, in batches of {BATCH}: medians of {ROUNDS} passes over
{NUM_IMAGES:,} images, all ways in turns, on one thread, with files in the page cache. Scenes are dense tensors from two
shards, of random Gaussians, with a row of their own where their tokens are made, too. Images are decoded by Pillow,
from JPEG of quality {QUALITY} and from PNG, each a file in memory, to float tensors in [0, 1]. Bytes are those of one
image."""


class Files(Dataset[Tensor]):
    """A data set of encoded images in memory."""

    def __init__(self, images: Tensor, suffix: str) -> None:
        self.files: list[bytes] = []
        for image in (images * 255).round().byte().permute(0, 2, 3, 1).numpy():
            file = BytesIO()
            Image.fromarray(image).save(file, suffix, quality=QUALITY)
            self.files.append(file.getvalue())

    def __len__(self) -> int:
        """Return the number of files."""
        return len(self.files)

    def __getitem__(self, index: int) -> Tensor:
        """Decode an image."""
        levels = np.array(Image.open(BytesIO(self.files[index])))
        return torch.from_numpy(levels).permute(2, 0, 1).float().div_(255)


def write_shards(folder: Path, count: int, side: int, num_gaussians: int) -> None:
    """Write random scenes to two shards."""
    for number, part in enumerate((count // 2, count - count // 2)):
        generator = torch.Generator().manual_seed(number)
        means = torch.rand(part, num_gaussians, 2, generator=generator) * side
        cholesky = torch.rand(part, num_gaussians, 3, generator=generator) + 0.5
        colors = torch.rand(part, num_gaussians, 3, generator=generator)
        scenes = Scene(GaussianField(means, cholesky, colors, size=(side, side)))
        save_shard(folder / f"{number:05}.safetensors", scenes, [str(k) for k in range(part)], [30.0] * part)


def seconds_of(dataset: Any, with_tokens: bool) -> float:
    """Return the seconds of one shuffled pass over a data set."""
    collate, generator = getattr(dataset, "collate", None), torch.Generator().manual_seed(0)
    loader = DataLoader(dataset, BATCH, shuffle=True, collate_fn=collate, generator=generator)
    start = time.perf_counter()
    for batch in loader:
        if with_tokens:
            batch.tokens()
    return time.perf_counter() - start


def measure(image: str, data: str, quick: bool) -> list[Row]:
    """Time scenes and image files in turns."""
    side, num_gaussians = int(image.split()[0]), SIDES[image]
    count = QUICK_IMAGES if quick else NUM_IMAGES
    images = crops(image, count, data, quick)
    with TemporaryDirectory() as folder, threads(1):
        write_shards(Path(folder), count, side, num_gaussians)
        num_bytes = sum(path.stat().st_size for path in Path(folder).iterdir()) / count
        shards, files = SceneDataset(folder), {name: Files(images, name) for name in (JPEG, PNG)}
        ways: dict[str, tuple[Any, bool]] = {SHARDS: (shards, False), f"{SHARDS}, tokens": (shards, True)}
        ways |= {name: (each, False) for name, each in files.items()}
        times: dict[str, list[float]] = {name: [] for name in ways}
        for _ in range(1 if quick else ROUNDS):
            for name, way in ways.items():
                times[name].append(seconds_of(*way))
    sizes = {name: sum(map(len, each.files)) / count for name, each in files.items()}
    return [
        {
            "image": image, "n": num_gaussians, "method": name, "images_per_second": count / median(values),
            "bytes": sizes.get(name, num_bytes),
        }
        for name, values in times.items()
    ]  # fmt: skip


def jobs(options: Options) -> list[Job]:
    """List the sizes of images to time."""
    return [{"image": side, **options.image_arguments()} for side in SIDES if not options.quick or side == "32 x 32"]


def page(folder: Path, rows: list[Row]) -> Page:
    """Write the report."""
    speeds = {(row["image"], row["method"]): row["images_per_second"] for row in rows}
    for row in rows:
        row["times JPEG"] = row["images_per_second"] / speeds[row["image"], JPEG]
        row["side"] = int(row["image"].split()[0])
    save_lines(folder / "loading.png", [Panel("", rows, "side", "images_per_second", ("log", "log"))], "method", "side")
    ratios = {image: speeds[image, SHARDS] / speed for (image, method), speed in speeds.items() if method == JPEG}
    goals = [Goal(image, "times JPEG", GOAL, ratio, more_is_better=True) for image, ratio in ratios.items()]
    answer = " ".join(
        f"{image}: {speeds[image, SHARDS]:,.0f} images per second from shards, {ratio:.1f} times as many as from JPEG."
        for image, ratio in ratios.items()
    )
    table = means_table(rows, ["image", "n", "method"], "", ("images_per_second", "times JPEG", "bytes"))
    return Page(answer, "loading.png", join_sections(table, goals_table(goals)), missed_goals(goals), METHOD)
