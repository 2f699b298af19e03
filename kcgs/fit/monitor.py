"""Clock, history and best state of a fit."""

from __future__ import annotations

import math
import time
from typing import Any, Literal, NamedTuple

from torch import Tensor

from kcgs.functional import RegionMap, edge_band
from kcgs.nn import GaussianField

from .config import FitConfig

StopReason = Literal["iterations", "seconds", "target_psnr", "callback", "diverged"]


class HistoryEntry(NamedTuple):
    """One point of the curve of error against run time."""

    iteration: int
    seconds: float
    loss: float
    psnr: float
    ef_psnr: float
    num_gaussians: int


class FitResult(NamedTuple):
    """What a fit gives back.

    `regions` is what the field must be drawn with: None where nothing is confined. `removed` Gaussians were left out
    at the end, which changed no value of the image by more than `change`.
    """

    field: GaussianField
    regions: RegionMap | None
    history: list[HistoryEntry]
    stop_reason: StopReason
    config: FitConfig
    removed: int = 0
    change: float = 0.0


class Gaussians(NamedTuple):
    """What is drawn: Gaussians, their regions' ids, and the map."""

    means: Tensor  # [N, 2]
    cholesky: Tensor  # [N, 3]
    colors: Tensor  # [N, C]
    ids: Tensor | None  # [N]
    regions: RegionMap | None

    def detached(self) -> Gaussians:
        """Copy, without the graph."""
        means, cholesky, colors = (t.detach().clone() for t in self[:3])
        return Gaussians(means, cholesky, colors, self.ids, self.regions)

    def field(self, size: tuple[int, int]) -> GaussianField:
        """Make a field of them."""
        means, cholesky, colors = (t.detach() for t in self[:3])
        return GaussianField(means, cholesky, colors, self.ids, size=size)


class Monitor:
    """Clock, history and best state of a fit."""

    def __init__(self, image: Tensor, regions: RegionMap | None, start: float) -> None:
        self.image = image
        self.start = start
        self.history: list[HistoryEntry] = []
        self.best_psnr = -math.inf
        self.best: Gaussians | None = None
        band = edge_band(regions.labels) if regions is not None else None
        self.band = None if band is None or not bool(band.any()) else band.flatten().nonzero().flatten()

    def seconds(self) -> float:
        """Wall time since the fit began."""
        return time.perf_counter() - self.start

    def log(self, iteration: int, loss: float, picture: Tensor, drawn: Gaussians) -> None:
        """Measure a picture (C, H, W), write it down, and keep the Gaussians if it is the best so far."""
        error = (picture.detach().clamp(0.0, 1.0) - self.image).square_().flatten(1)
        psnr = decibel(float(error.mean()))
        ef_psnr = math.nan if self.band is None else decibel(float(error.index_select(1, self.band).mean()))
        self.history.append(HistoryEntry(iteration, self.seconds(), loss, psnr, ef_psnr, len(drawn.means)))
        if psnr > self.best_psnr:
            self.best_psnr = psnr
            self.best = drawn.detached()

    def forget_best(self) -> None:
        """Let the next state be the best; the history stays."""
        self.best_psnr = -math.inf

    def state(self) -> dict[str, Any]:
        """Return everything a resumed fit needs."""
        return {"seconds": self.seconds(), "history": self.history, "best_psnr": self.best_psnr, "best": self.best}

    def load(self, state: dict[str, Any]) -> None:
        """Take up a state; the clock goes on from where it stood."""
        self.start = time.perf_counter() - state["seconds"]
        self.history, self.best_psnr, self.best = state["history"], state["best_psnr"], state["best"]


def decibel(mean_square: float) -> float:
    """PSNR of a mean squared error, for values in [0, 1]."""
    return math.inf if mean_square == 0 else -10.0 * math.log10(mean_square)
