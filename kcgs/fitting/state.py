"""What a fit knows and gives back: plain data, which the loop and the strategies read and change."""

from __future__ import annotations

import dataclasses
import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple

from torch import Tensor

from kcgs.functional import RegionMap
from kcgs.nn import GaussianField
from kcgs.plots import history_figure
from kcgs.scene import Scene

from .config import FitConfig
from .objective import MsSsimObjective
from .optimizers import GaussianOptimizer
from .region_report import RegionReport

if TYPE_CHECKING:
    from matplotlib.figure import Figure

StopReason = Literal["iterations", "seconds", "target_psnr", "callback", "diverged"]


class HistoryEntry(NamedTuple):
    """One point of the curve of error against run time.

    EF-PSNR is taken along the contours of the map that was given, wherever the fit moves them: those of the scene's map
    are what :func:`kcgs.evaluate` looks at by default. NaN without contours.
    """

    iteration: int
    seconds: float
    loss: float
    psnr: float
    ef_psnr: float
    num_gaussians: int


class FitResult(NamedTuple):
    """What a fit gives back."""

    scene: Scene
    """Without regions where nothing is confined."""
    history: list[HistoryEntry]
    """Its EF-PSNR is along the contours of the map that was given, not of the scene's; see :class:`HistoryEntry`."""
    stop_reason: StopReason
    config: FitConfig
    removed: int = 0
    """Gaussians that were left out at the end."""
    change: float = 0.0
    """No value of the render changed by more when they were."""
    regions: RegionReport | None = None
    """What became of the label map; None: none was given."""
    seconds: float = 0.0
    """Wall time of all that was done; the history of a search is that of one fit."""

    def __repr__(self) -> str:
        psnr = max((entry.psnr for entry in self.history), default=math.nan)
        return f"FitResult({psnr:.2f} dB, stopped by {self.stop_reason}, {self.seconds:.1f} s, {self.scene!r})"

    def _repr_png_(self) -> bytes | None:
        return self.scene._repr_png_()

    def plot(self) -> Figure:
        """Plot PSNR and EF-PSNR against run time and iterations; save it with its `savefig`."""
        figure: Figure = history_figure(self.history)
        return figure


class Gaussians(NamedTuple):
    """What is rendered: Gaussians, their region ids, and the map."""

    means: Tensor  # [N, 2]
    cholesky: Tensor  # [N, 3]
    colors: Tensor  # [N, C]
    region_ids: Tensor | None  # [N]
    regions: RegionMap | None

    def detached(self) -> Gaussians:
        """Copy, without the graph."""
        means, cholesky, colors = (t.detach().clone() for t in self[:3])
        return Gaussians(means, cholesky, colors, self.region_ids, self.regions)

    def scene(self, size: tuple[int, int]) -> Scene:
        """Make a scene of them."""
        means, cholesky, colors = (t.detach() for t in self[:3])
        return Scene(GaussianField(means, cholesky, colors, self.region_ids, size=size), self.regions)


@dataclass
class FitState:
    """A fit in progress; `start` fills it, strategies change it, and a checkpoint keeps what is not the problem."""

    # The problem
    image: Tensor  # [C, H, W]
    config: FitConfig
    num_gaussians: int
    seed: int
    started: float  # reading of the clock
    clamp: bool  # clip the render to [0, 1] in training
    band: Tensor | None  # pixels near a contour of the given map, where EF-PSNR is measured
    given: RegionMap | None  # the map as it came
    objective: MsSsimObjective | None  # what the descent lowers; None: what `loss` says

    # What is rendered
    cutoff: float
    regions: RegionMap | None
    region_ids: Tensor | None  # of the Gaussians
    optimizer: GaussianOptimizer  # holds the Gaussians
    anchor: Tensor | None  # labels that contours may not move far from

    # What has happened
    first: int  # Gaussians at the start
    wanted: int  # Gaussians that were asked for so far
    iteration: int = 0
    densifications: int = 0
    late_moves: int = 0  # of contours, after densification

    # What was measured
    history: list[HistoryEntry] = dataclasses.field(default_factory=list)
    best: Gaussians | None = None
    best_score: float = float("-inf")

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of the image."""
        return self.image.shape[1], self.image.shape[2]

    @property
    def limit(self) -> float:
        """How many iterations there are; infinite where the clock alone ends the fit."""
        timed = self.config.iterations is None and self.config.max_seconds is not None
        return math.inf if timed else self.config.usual_iterations

    @property
    def chooses_widths(self) -> bool:
        """Whether the config asks for widths, and the map came without."""
        return self.config.softness == "auto" and self.given is not None and self.given.softness == 0.0

    def seconds(self) -> float:
        """Wall time since the fit began."""
        return time.perf_counter() - self.started

    def progress(self) -> float:
        """Share of the fit that is done: of its iterations or of its seconds, whichever is more.

        Learning rates and strategies go by it, so that a fit ends in time whichever runs out first.
        """
        done = self.iteration / self.limit
        return done if self.config.max_seconds is None else max(done, self.seconds() / self.config.max_seconds)

    def length(self) -> float:
        """About how many iterations the fit will take."""
        return self.limit if self.config.max_seconds is None else self.iteration / max(self.progress(), 1e-9)

    def count(self) -> int:
        """Return how many Gaussians there are now."""
        return len(self.optimizer.raw[-1])

    def gaussians(self) -> Gaussians:
        """Return what is rendered now."""
        return Gaussians(*self.optimizer.gaussians(), self.region_ids, self.regions)
