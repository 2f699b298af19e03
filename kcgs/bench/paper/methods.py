"""What is compared: recipes, by the names that tables have."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

from kcgs.fit import FitConfig

# recipes as published: their own 50,000 iterations take a quarter of an hour a photo on a processor core
PUBLISHED = ("paper", "gaussian-image", "gaussian-image-clamp")
FULL_ITERATIONS = 50_000
QUICK_ITERATIONS = 20


class Method(NamedTuple):
    """A recipe with some of its settings changed."""

    name: str
    recipe: str
    changes: tuple[tuple[str, Any], ...] = ()

    @property
    def is_published(self) -> bool:
        """Whether it is the paper's or its baseline's, in whatever form."""
        return self.recipe in PUBLISHED

    def config(self, iterations: int | None = None) -> FitConfig:
        """All settings; `iterations` None: the recipe's own."""
        return _config(self.recipe, self.changes, iterations)


def method(name: str, recipe: str | None = None, **changes: Any) -> Method:
    """Make a method; the recipe is by default the one of that name."""
    return Method(name, recipe or name, tuple(sorted(changes.items())))


CLAMPED = method("gaussian-image-clamp")
UNCLAMPED = method("gaussian-image")
PAPER_CLAMPED = method("paper, clamp", "paper", clamp=True)
PAPER = method("paper")
BASELINE = method("best-baseline")
BEST = method("best")
REFINED = method("best-refined")
# hard contours at many labels a pixel, which pictures with exact contours have
COVERAGE = method("best, sub-pixel coverage", "best", move_contours=False, softness=0.0)


@lru_cache
def _config(recipe: str, changes: tuple[tuple[str, Any], ...], iterations: int | None) -> FitConfig:
    settings = dict(changes) if iterations is None else {**dict(changes), "iterations": iterations}
    return FitConfig.from_recipe(recipe, **settings)
