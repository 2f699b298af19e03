"""What is fitted: image, label map, recipe, N, seed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from torch import Tensor

from kcgs.fitting import FitConfig
from kcgs.functional import RegionMap

from . import images
from .options import Options

# recipes as published: 50,000 iterations take a quarter of an hour per photo on a processor core
PUBLISHED = ("paper", "gaussian-image", "gaussian-image-clamp", "image-gs")
PUBLISHED_ITERATIONS = 2_000
QUICK_ITERATIONS = 20


class Method(NamedTuple):
    """A recipe with some of its settings changed."""

    name: str  # in tables
    recipe: str
    changes: tuple[tuple[str, Any], ...] = ()

    @property
    def is_published(self) -> bool:
        """Whether it is a published method, in whatever form."""
        return self.recipe in PUBLISHED

    def config(self, iterations: int | None = None) -> FitConfig:
        """All settings; `iterations` None: the recipe's own."""
        return _config(self.recipe, self.changes, iterations)


@lru_cache
def _config(recipe: str, changes: tuple[tuple[str, Any], ...], iterations: int | None) -> FitConfig:
    settings = dict(changes) if iterations is None else {**dict(changes), "iterations": iterations}
    return FitConfig.from_recipe(recipe, **settings)


def method(name: str, recipe: str | None = None, **changes: Any) -> Method:
    """Make a method; the recipe is by default the one of that name."""
    return Method(name, recipe or name, tuple(sorted(changes.items())))


CLAMPED = method("gaussian-image-clamp")
UNCLAMPED = method("gaussian-image")
IMAGE_GS = method("image-gs")
PAPER_CLAMPED = method("paper, clamp", "paper", clamp=True)
PAPER = method("paper")
BASELINE = method("best-baseline")
BEST = method("best")
REFINED = method("best-refined")


class Case(NamedTuple):
    """One fit."""

    image: str
    n: int
    method: Method
    seed: int = 0
    iterations: int | None = None  # none: the recipe's own
    stride: int = 1  # one of so many pixels is taken
    source: str = "given"  # of the label map: the image's own, or a segmenter by name
    factor: int = 1  # that the image is reduced by

    def config(self) -> FitConfig:
        """All settings."""
        return self.method.config(self.iterations)

    def load(self, data: Path | None) -> images.Sample:
        """Read the image."""
        return images.load(self.image, data, self.stride, self.factor)

    def regions(self, labels: Tensor | None) -> RegionMap | None:
        """Return the map that the fit is given, from the image's labels."""
        return None if labels is None else RegionMap.from_labels(labels)

    def settings(self) -> str:
        """Write N and all settings."""
        return f"{self.n} {self.method.name} {self.config().model_dump_json()}"

    def __str__(self) -> str:
        parts = [self.image, f"N = {self.n:,}", self.method.name]
        parts += [f"reduced by {self.factor}"] if self.factor > 1 else []
        parts += [f"map: {self.source}"] if self.source != "given" else []
        return ", ".join(parts + ([f"seed {self.seed}"] if self.seed else []))


def plan(
    names: Iterable[str],
    counts: Sequence[int],
    methods: Sequence[Method],
    options: Options,
    iterations: int,
    stride: int,
) -> list[Case]:
    """List cases, image by image, N by N; published recipes have these iterations, the quick form this stride."""
    published, stride = options.iterations or iterations, stride if options.quick else 1
    return [
        Case(name, n, m, seed, QUICK_ITERATIONS if options.quick else published if m.is_published else None, stride)
        for name in names
        for n in counts
        for seed in range(options.seeds)
        for m in methods
    ]
