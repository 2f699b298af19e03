"""What a fit returns."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from kcgs.plots import history_figure
from kcgs.scene import Scene

from .config import FitConfig
from .region_report import RegionReport

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class HistoryEntry(NamedTuple):
    """One point of the curve of error against run time.

    Of a batch loss, PSNR and EF-PSNR are means over its images, without those that diverged; EF-PSNR also without those
    that have no contour. The PSNR of an image without error is infinite, and so is the mean.

    EF-PSNR is taken along the contours of the user's map, wherever the fit moves them: those of the scene's map are
    what :func:`kcgs.evaluate` looks at by default. NaN without contours.
    """

    iteration: int
    seconds: float
    loss: float
    psnr: float
    ef_psnr: float
    num_gaussians: int


class FitResult(NamedTuple):
    """What a fit returns."""

    scene: Scene
    """Without regions where nothing is confined; a batch for a batch of images, with as many rows for each image: rows
    that one has no use for have the colour 0."""
    history: list[HistoryEntry]
    """Its EF-PSNR is along the contours of the user's map, not of the scene's; see :class:`HistoryEntry`."""
    stop_reason: str
    """iterations, seconds, target_psnr, callback or diverged; or what an event of yours returned."""
    config: FitConfig
    num_pruned: int | Tensor = 0
    """Gaussians that were removed at the end since they changed the render by next to nothing; of a batch (B,)."""
    prune_error: float | Tensor = 0.0
    """No value of the render changed by more when they were; of a batch (B,)."""
    regions: RegionReport | list[RegionReport] | None = None
    """What became of the label map, or of that of each image of a batch; None without one."""
    seconds: float = 0.0
    """Wall time from the start to the pruned scene, without compilation; a search counts all its fits."""
    psnr: float | Tensor = math.nan
    """Of the scene before pruning, in dB; of a batch (B,), on the CPU; NaN without an image."""

    diverged: tuple[int, ...] = ()
    """Images whose numbers overflowed; their scenes are the best of before."""

    def of_image(self, index: int) -> FitResult:
        """Return the result of one image of a batch: its scene, without rows of the colour 0, PSNR and report.

        The history stays that of the batch.

        Example:
            >>> from kcgs import fit
            >>> images = torch.stack([torch.zeros(3, 16, 24), torch.rand(3, 16, 24)])
            >>> batch = fit(images, num_gaussians=8, iterations=20)
            >>> batch.of_image(0).scene.num_gaussians, batch.of_image(1).scene.num_gaussians
            (0, 8)
        """
        scene = self.scene[index]
        field = scene.field.subset((scene.field.colors != 0).any(-1))
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
        """Plot PSNR and EF-PSNR against run time and iterations; save it with its `savefig`."""
        figure: Figure = history_figure(self.history)
        return figure
