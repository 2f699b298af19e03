"""The state of a fit."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch

from kcgs._warn import warn_user
from kcgs.kernels import MEAN_LIMIT
from kcgs.maps import RegionMap
from kcgs.optim import FieldState, is_within
from kcgs.scene import Scene

from .best import Best
from .problem import Problem
from .result import HistoryEntry

# larger numbers count as diverged: the renderer does not accept such centres
LARGEST = MEAN_LIMIT


@dataclass(kw_only=True, repr=False)
class FitState(FieldState):
    """A fit in progress: `start` makes it, events and steps change it, a checkpoint stores it."""

    problem: Problem
    anchor: RegionMap | None
    """The map that contours may not move far from."""
    num_initial: int
    """Rows at the start."""
    initial_counts: list[int] = field(default_factory=list)
    """Gaussians of each image at the start, if some images have fewer than `num_initial`; else empty."""
    num_requested: int
    """Gaussians per image that the schedule last asked for; an image has fewer where more did not lower its error."""
    num_additions: int = 0
    """How often Gaussians were added."""
    num_cycles: int = 0
    """Planned cycles of removals and additions; 0 while the number of Gaussians still grows."""
    num_late_moves: int = 0
    """How often contours moved after densification."""
    contour_seconds: list[float] = field(default_factory=list)
    """Seconds that each move of the contours took, in a fit with a clock."""
    history: list[HistoryEntry] = field(default_factory=list)
    best: Best | None = None
    """The best measured scene of each image."""
    diverged: list[int] = field(default_factory=list)
    """Images whose numbers overflowed; they keep their best scene from before."""

    def __repr__(self) -> str:
        return f"FitState(iteration {self.iteration}, progress {self.progress:.2f}, {self.scene!r})"

    @property
    def scene(self) -> Scene:
        """The field that the optimizer moves, and the map."""
        return Scene(self.field, self.regions)

    @property
    def num_gaussians(self) -> int:
        """Current rows of each image, including unused rows."""
        return self.field.num_gaussians

    @property
    def is_draft(self) -> bool:
        """True while the cutoff is still the draft cutoff."""
        return self.renderer.cutoff != self.problem.config.cutoff

    def overflowing_images(self) -> list[int]:
        """Return the images with a number that is not finite or too large."""
        tables = [self.field.means, self.field.cholesky, self.field.colors]
        if is_within(tables, LARGEST):
            return []
        return [image for image in range(len(tables[0])) if not is_within([table[image] for table in tables], LARGEST)]

    @property
    def expected_iterations(self) -> float:
        """Expected number of iterations of the whole fit."""
        config = self.problem.config
        if config.max_seconds is None:
            return config.planned_iterations
        return self.iteration / max(self.progress, 1e-9)

    @property
    def all_diverged(self) -> bool:
        """True if every image diverged."""
        return len(self.diverged) == self.problem.num_images

    @torch.no_grad()
    def exclude(self, images: list[int]) -> None:
        """Mark overflowing images as diverged, with a warning.

        If other images are left, the rows of diverged images become unused and are frozen.
        """
        if new := [image for image in images if image not in self.diverged]:
            self.diverged += new
            numbers = f"image{'s' * (len(new) > 1)} {', '.join(map(str, new))} of the batch"
            which = "the fit" if self.problem.num_images == 1 else numbers
            warn_user(f"{which} diverged at iteration {self.iteration}: the best so far is kept")
        if not images or self.all_diverged:
            return
        field = self.field
        for table, fill in ((field.means, 1.0), (field.cholesky, 1.0), (field.colors, 0.0)):
            table[images] = fill
        mask = torch.zeros_like(field.means[..., 0], dtype=torch.bool)
        mask[images] = True
        self.optimizer.freeze(field, mask)

    def end_drafts(self) -> None:
        """Render with the cutoff of the result from here on."""
        self.renderer = self.renderer._replace(cutoff=self.problem.config.cutoff)
