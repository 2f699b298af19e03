"""Which fits the experiment consists of, and the pictures they are made of."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from kcgs.data import ChartSample, Davis, chart_2x3, chart_pie, load_image, load_labels
from kcgs.fit import FitConfig
from kcgs.functional import RegionMap

BASELINE = "best-baseline"
BEST = "best"
KEPT = "best --keep-contours"
REFINED = "best-refined"
PAPER = "paper"
PUBLISHED_BASELINE = "gaussian-image"
COVERAGE = "best, sub-pixel coverage"
LIMITED = "best, at most 3 s"
SHORT = "best-baseline, 1,000 iterations"
RIVALS = (KEPT, BEST, REFINED)

SEQUENCES = (
    *("blackswan", "breakdance", "car-turn", "dance-jump", "dog", "mallard-water", "motocross-jump", "rollerblade"),
    "train",
)
LEAST_SEQUENCES = 8
# stands in for motocross-jump where that is missing
STAND_IN = "rollerblade"
PAPER_SEQUENCES = ("blackswan",)
TIME_SEQUENCES = ("blackswan", "dog", "train")
PAPER_ITERATIONS = 20_000
SHORT_ITERATIONS = 1_000
QUICK_ITERATIONS = 20
QUICK_STRIDE = 2
SECONDS = 3.0
# a pixel of the pie is the mean of 8 x 8 samples: at this many labels a pixel its contours are exact
COVERAGE_LABELS = 8

# the sub-folder of the data that a group reads; None: it needs no data
GROUPS: dict[str, str | None] = {
    "davis": "DAVIS",
    "bsds": "bsds",
    "paper": "DAVIS",
    "time": "DAVIS",
    "charts": None,
    "kodak": "kodak",
    "astronaut": None,
}
# groups whose seconds are held against each other: nothing else may run meanwhile
TIMED = ("paper", "time")
# the recipe of a group that a baseline at equal bytes is made for
COMPARED = {"davis": BEST, "bsds": REFINED, "astronaut": BEST}

_RECIPES: dict[str, tuple[str, dict[str, Any]]] = {
    KEPT: ("best", {"move_contours": False, "merge_regions": False}),
    PAPER: ("paper", {"iterations": PAPER_ITERATIONS}),
    COVERAGE: ("best", {"move_contours": False, "softness": 0.0}),
    LIMITED: ("best", {"max_seconds": SECONDS}),
    SHORT: ("best-baseline", {"iterations": SHORT_ITERATIONS}),
}


class Case(NamedTuple):
    """One fit: what, with how many Gaussians, by which recipe (`name` is how tables call it)."""

    group: str
    image: str
    n: int
    name: str
    recipe: str
    overrides: dict[str, Any]
    seed: int = 0
    stride: int = 1  # every how many pixels are taken

    def config(self) -> FitConfig:
        """All settings."""
        return _resolve(self.recipe, tuple(sorted(self.overrides.items())))

    def key(self, *more: Any) -> str:
        """Hash everything that the result depends on, and `more`."""
        parts = [*self, self.config().model_dump(mode="json"), more]
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:20]


class Problem(NamedTuple):
    """What a fit is given, and the label map whose band it is judged in."""

    image: Tensor
    labels: Tensor | None
    regions: RegionMap | None


def make_case(group: str, image: str, n: int, name: str, *, quick: bool = False) -> Case:
    """Make a case of a recipe by the name it has in tables; a quick one has few iterations."""
    recipe, overrides = _RECIPES.get(name, (name, {}))
    if not quick:
        return Case(group, image, n, name, recipe, overrides)
    return Case(group, image, n, name, recipe, {**overrides, "iterations": QUICK_ITERATIONS}, stride=QUICK_STRIDE)


def cases(group: str, data: Path | None, quick: bool) -> list[Case]:
    """List the fits of a group, all recipes of one picture and N beside each other."""
    images, counts, names = _plan(group, data, quick)
    if quick:
        images, counts = images[:1], (min(60, counts[0]),)
    made = [make_case(group, i, n, name, quick=quick) for i in images for n in counts for name in names]
    if group == "charts" and not quick:
        made.append(make_case(group, "pie", counts[0], COVERAGE))
    return made


def missing(group: str, data: Path | None) -> str | None:
    """Say why a group cannot be run; None: it can."""
    folder = GROUPS[group]
    if folder is None:
        return None
    if data is None:
        return "no --data folder was given"
    return None if (data / folder).is_dir() else f"there is no folder {folder} in the data"


def load(case: Case, data: Path | None) -> Problem:
    """Read the picture of a case."""
    image, labels = _read(GROUPS[case.group], case.image, data)
    if case.stride > 1:
        image = image[:, :: case.stride, :: case.stride].contiguous()
        labels = None if labels is None else labels[:: case.stride, :: case.stride].contiguous()
    if case.name == COVERAGE:
        fine = chart_pie(COVERAGE_LABELS).labels
        return Problem(image, labels, RegionMap.from_labels(fine, supersample=COVERAGE_LABELS))
    return Problem(image, labels, None if labels is None else RegionMap.from_labels(labels))


def _plan(group: str, data: Path | None, quick: bool) -> tuple[list[str], tuple[int, ...], tuple[str, ...]]:
    """Return a group's pictures, its N and its recipes."""
    folder = GROUPS[group]
    if folder is None:
        if group == "charts":
            return list(_CHARTS), (20,), (PUBLISHED_BASELINE, BASELINE, BEST)
        # few recipes where it must be quick
        return ["astronaut"], (400, 1_500), (BASELINE, KEPT, BEST, *(() if quick else (REFINED,)))
    assert data is not None
    root = data / folder
    if group == "bsds":
        found = sorted((p.parent.name for p in root.glob("*/mask.png")), key=lambda name: (len(name), name))
        return found, (400, 1_000), (BASELINE, KEPT, BEST, REFINED)
    if group == "kodak":
        return sorted(p.stem for p in root.glob("kodim*.png")), (9_000,), (SHORT, BASELINE)
    present = Davis(root).sequences
    if group == "paper":
        return _choose(present, PAPER_SEQUENCES), (1_250, 7_500), (PAPER, BASELINE, BEST)
    if group == "time":
        return _choose(present, TIME_SEQUENCES), (1_250, 7_500), (BEST, LIMITED)
    wanted = [s for s in SEQUENCES if s != STAND_IN or "motocross-jump" not in present]
    return _choose(present, wanted, LEAST_SEQUENCES), (1_250, 7_500), (BASELINE, BEST)


def _choose(present: list[str], wanted: tuple[str, ...] | list[str], least: int | None = None) -> list[str]:
    """Keep the wanted names that are there, and fill up with others where that leaves too few."""
    chosen = [name for name in wanted if name in present]
    least = len(wanted) if least is None else least
    return chosen + [name for name in present if name not in chosen][: max(0, least - len(chosen))]


@lru_cache
def _resolve(recipe: str, overrides: tuple[tuple[str, Any], ...]) -> FitConfig:
    return FitConfig.from_recipe(recipe, **dict(overrides))


@lru_cache(maxsize=2)
def _read(folder: str | None, image: str, data: Path | None) -> tuple[Tensor, Tensor | None]:
    if folder is None:
        chart = _CHARTS.get(image, _astronaut)()
        return chart.image, chart.labels
    assert data is not None
    root = data / folder
    if folder == "DAVIS":
        frame = Davis(root)[image]
        return frame.image, frame.labels
    if folder == "bsds":
        return load_image(root / image / "image.jpg"), load_labels(root / image / "mask.png")
    return load_image(root / f"{image}.png"), None


def _astronaut() -> ChartSample:
    from skimage import data as photos

    from kcgs.segment import segment

    image = torch.from_numpy(photos.astronaut()).permute(2, 0, 1).float() / 255
    return ChartSample(image, segment(image))


_CHARTS: dict[str, Callable[[], ChartSample]] = {"2x3": chart_2x3, "pie": chart_pie}
