"""What is decoded: scenes made by rule, and pictures fitted once and kept on disk."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from kcgs.bench.render.workloads import STANDARD, workload
from kcgs.data import Davis
from kcgs.fit import FitConfig, fit
from kcgs.functional import RegionMap
from kcgs.io import load, save
from kcgs.nn import GaussianField
from kcgs.segment import segment

CONTOURS = ("none", "hard", "soft")
SOFTNESS = 0.7
WORKLOADS = ("W1", "W2")
SEQUENCE = "blackswan"
RECIPE = "best"
QUICK_SIZE = (96, 128)
QUICK_COUNT = 60
QUICK_ITERATIONS = 20


class Scene(NamedTuple):
    """A picture to draw; `source` says where it is from."""

    name: str
    source: str
    field: GaussianField
    regions: RegionMap | None

    @property
    def size(self) -> tuple[int, int]:
        """(height, width)."""
        return self.field.size

    @property
    def contours(self) -> str:
        """none, hard or soft, as a decoder's metadata has it."""
        if self.regions is None or self.regions.num_regions == 1:
            return "none"
        return "hard" if self.regions.softness == 0.0 else "soft"


def standard_scenes(quick: bool) -> list[Scene]:
    """Make the renderer benchmark's workloads, each with no regions, with hard contours and with soft ones."""
    sizes = {"small": (*QUICK_SIZE, QUICK_COUNT)} if quick else {name: STANDARD[name] for name in WORKLOADS}
    made = []
    for name, (height, width, count) in sizes.items():
        scattered = workload(name, height, width, count)
        for contours in CONTOURS:
            regions = None
            if contours != "none":
                regions = RegionMap.from_labels(scattered.regions.labels, SOFTNESS if contours == "soft" else 0.0)
            field = GaussianField(
                scattered.means,
                scattered.cholesky,
                scattered.colors,
                None if regions is None else scattered.region_ids,
                size=(height, width),
            )
            made.append(Scene(f"{name} {contours}", f"workload {name} of `kcgs bench render`", field, regions))
    return made


def fitted_scenes(folder: Path, data: Path | None, quick: bool) -> list[Scene]:
    """Read the fits from the folder; those that are not there, or were made by other settings, are made.

    Args:
        folder: for the scenes; made if there is something to keep.
        data: folder with DAVIS in it.
        quick: a crop of scikit-image's photo and few iterations instead.
    """
    if why_not_fitted(data, quick) is not None:
        return []
    settings: dict[str, Any] = {"iterations": QUICK_ITERATIONS} if quick else {}
    config = FitConfig.from_recipe(RECIPE, **settings)
    name, counts = ("astronaut", (QUICK_COUNT,)) if quick else (SEQUENCE, tuple(STANDARD[w][2] for w in WORKLOADS))
    read = _photo if quick or data is None else partial(_frame, data)
    folder.mkdir(exist_ok=True)
    return [_fitted(folder / f"{name}-{n}.safetensors", name, n, config, read) for n in counts]


def why_not_fitted(data: Path | None, quick: bool) -> str | None:
    """Say why there are no fitted scenes; None: there are."""
    if quick:
        return None
    if data is None:
        return "no folder with images was given (--data)"
    wanted = data / "DAVIS"
    return None if wanted.is_dir() else f"there is no folder {wanted.name} in the data"


def _fitted(path: Path, name: str, count: int, config: FitConfig, read: Callable[[], tuple[Tensor, Tensor]]) -> Scene:
    settings = json.dumps([name, count, config.model_dump(mode="json")], sort_keys=True)
    key = hashlib.sha256(settings.encode()).hexdigest()[:20]
    if not path.is_file() or load(path).metadata.get("settings") != key:
        result = fit(*read(), count, config=config)
        notes = {"recipe": RECIPE, "settings": key, "psnr": f"{result.history[-1].psnr:.2f}"}
        save(path, result.field, result.regions, metadata=notes)
    # drawn as read, so that the first run and the next have the same scene
    field, regions, notes = load(path)
    source = f"{name} fitted by recipe {RECIPE} with {count:,} Gaussians, {notes['psnr']} dB"
    return Scene(f"{name} {count}", source, field, regions)


def _frame(data: Path) -> tuple[Tensor, Tensor]:
    _, image, labels = Davis(data / "DAVIS", sequences=[SEQUENCE])[SEQUENCE]
    return image, labels


def _photo() -> tuple[Tensor, Tensor]:
    from skimage import data as photos

    height, width = QUICK_SIZE
    image = torch.from_numpy(photos.astronaut()).permute(2, 0, 1).float()[:, 20 : 20 + height, 160 : 160 + width] / 255
    return image, segment(image)
