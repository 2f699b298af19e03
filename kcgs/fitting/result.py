"""The result of a fit."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from kcgs.nn import used_rows
from kcgs.plots import history_figure
from kcgs.scene import Scene

from .config import FitConfig
from .region_report import RegionReport

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class HistoryEntry(NamedTuple):
    """One point of the curve of error against run time.

    For a batch, loss, PSNR and EF-PSNR are means over the images, without diverged images; EF-PSNR also without images
    that have no contour. The PSNR of an image without error is infinite, and so is the mean.

    EF-PSNR is measured along the contours of the user's map, wherever the fit moves them; NaN without contours.
    :func:`kcgs.evaluate` measures along the contours of the scene's map by default.
    """

    iteration: int
    seconds: float
    loss: float
    psnr: float
    ef_psnr: float
    num_gaussians: int


class FitResult(NamedTuple):
    """The scene of a fit, its history, and why it ended."""

    scene: Scene
    """Without regions if nothing is confined. For a batch of images a batch, with the same number of rows for each
    image: rows that an image does not need are unused, with the colour 0."""
    history: list[HistoryEntry]
    """Its EF-PSNR is measured along the contours of the user's map, not of the scene's: see :class:`HistoryEntry`."""
    stop_reason: str
    """One of iterations, seconds, target_psnr, callback, diverged; or the string that your event returned."""
    config: FitConfig
    num_pruned: int | Tensor = 0
    """Number of Gaussians that were removed at the end because they hardly changed the render; (B,) for a batch."""
    prune_error: float | Tensor = 0.0
    """Largest change of a value of the render by this removal; (B,) for a batch."""
    regions: RegionReport | list[RegionReport] | None = None
    """What became of the label map, or of the map of each image of a batch; None without a map."""
    seconds: float = 0.0
    """Wall time of the fit, or of all fits of a search, with pruning; `max_seconds` does not count compilation."""
    psnr: float | Tensor = math.nan
    """PSNR of the scene before pruning, in dB; (B,) on the CPU for a batch; NaN without an image."""

    diverged: tuple[int, ...] = ()
    """Images whose numbers overflowed; they keep their best scene from before."""

    def of_image(self, index: int) -> FitResult:
        """Return the result of one image of a batch: its scene without unused rows, its PSNR and its report.

        The history is still that of the batch.

        Example:
            >>> from kcgs import fit
            >>> images = torch.stack([torch.zeros(3, 16, 24), torch.rand(3, 16, 24)])
            >>> batch = fit(images, num_gaussians=8, iterations=20)
            >>> batch.of_image(0).scene.num_gaussians, batch.of_image(1).scene.num_gaussians
            (0, 8)
        """
        index, scene = range(len(self.scene))[index], self.scene[index]
        field = scene.field.subset(used_rows(scene.field.colors))
        numbers = (torch.as_tensor(values)[index].item() for values in (self.num_pruned, self.prune_error, self.psnr))
        num_pruned, prune_error, psnr = numbers
        return self._replace(
            scene=Scene(field, scene.regions, scene.metadata), num_pruned=int(num_pruned), prune_error=prune_error,
            psnr=psnr, regions=self.regions[index] if isinstance(self.regions, list) else None,
            diverged=(0,) if index in self.diverged else (),
        )  # fmt: skip

    def __repr__(self) -> str:
        psnr = float(torch.as_tensor(self.psnr).mean())
        return f"FitResult({psnr:.2f} dB, stopped by {self.stop_reason}, {self.seconds:.1f} s, {self.scene!r})"

    def _repr_png_(self) -> bytes | None:
        return self.scene._repr_png_()

    def plot(self) -> Figure:
        """Plot PSNR and EF-PSNR against run time and iterations; the figure's `savefig` saves it."""
        figure: Figure = history_figure(self.history)
        return figure
