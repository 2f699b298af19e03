"""The first look: one photo, the baseline and the contour-aware fit side by side."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from kcgs.data import colorize_labels, save_image, save_labels
from kcgs.fit import FitConfig, FitResult, HistoryEntry, fit
from kcgs.functional import edge_band
from kcgs.io import save
from kcgs.nn.renderer import render_image
from kcgs.segment import segment

from .measure import measure
from .plots import figure, save_figure

if TYPE_CHECKING:
    from rich.progress import Progress
    from torch import Tensor

NUM_GAUSSIANS = 400
QUICK_STRIDE = 4
QUICK_GAUSSIANS = 60
QUICK_ITERATIONS = 20
RECIPES = {"baseline": "best-baseline", "contour-aware": "best"}


def run(output: Path, *, data: Path | None = None, quick: bool = False) -> None:
    """Fit scikit-image's astronaut twice and write pictures, scenes and the error-against-time plot.

    Args:
        output: folder for all of it.
        data: not read; what every bench takes.
        quick: a quarter of the size, fewer Gaussians, few iterations.
    """
    from rich.console import Console
    from rich.progress import Progress

    image, count = _astronaut(), NUM_GAUSSIANS
    if quick:
        image, count = torch.nn.functional.avg_pool2d(image, QUICK_STRIDE), QUICK_GAUSSIANS
    labels = segment(image)
    save_image(output / "original.png", image)
    save_image(output / "regions.png", colorize_labels(labels))
    save_labels(output / "labels.png", labels)
    # the map was found, not given: its contours may move
    settings: dict[str, Any] = {"max_move": "any", **({"iterations": QUICK_ITERATIONS} if quick else {})}
    console = Console(stderr=True)
    results: dict[str, FitResult] = {}
    with Progress(console=console, disable=not console.is_terminal) as progress:
        for name, recipe in RECIPES.items():
            results[name] = _fit(image, labels, count, FitConfig.from_recipe(recipe, **settings), name, progress)
            save(output / f"{name}.safetensors", results[name].field, results[name].regions)
    pictures = {name: render_image(r.field, r.regions) for name, r in results.items()}
    for name, picture in pictures.items():
        save_image(output / f"{name}.png", picture)
    _plot_history(output / "error-against-time.png", results)
    _plot_strip(output / "comparison.png", image, labels, pictures)
    _print_table(pictures, image, labels, results, f"{count} Gaussians, pictures in {output}/")


def _astronaut() -> Tensor:
    from skimage import data as photos

    return torch.from_numpy(photos.astronaut()).permute(2, 0, 1).float() / 255


def _fit(image: Tensor, labels: Tensor, count: int, config: FitConfig, name: str, progress: Progress) -> FitResult:
    task = progress.add_task(name, total=config.iterations)

    def step(iteration: int, _: HistoryEntry) -> None:
        progress.update(task, completed=iteration)

    return fit(image, labels, count, config=config, on_step=step)


def _plot_history(path: Path, results: dict[str, FitResult]) -> None:
    plot, axes = figure(1, 2, width=9.0, height=3.6)
    for name, result in results.items():
        seconds = [h.seconds for h in result.history]
        axes[0].plot(seconds, [h.psnr for h in result.history], label=name)
        axes[1].plot(seconds, [h.ef_psnr for h in result.history], label=name)
    for axis, title in zip(axes, ("PSNR, whole image", "EF-PSNR, 5 pixels around contours"), strict=True):
        axis.set(xlabel="seconds", ylabel="dB", title=title, xscale="log")
        axis.legend(loc="lower right")
    save_figure(plot, path)


def _plot_strip(path: Path, image: Tensor, labels: Tensor, pictures: dict[str, Tensor]) -> None:
    side = labels.shape[1] // 4
    y, x = _busiest_window(labels, side)
    panels = {"original": image, "regions": colorize_labels(labels), **pictures}
    plot, axes = figure(2, len(panels), width=2.6 * len(panels), height=5.4)
    for column, (name, panel) in enumerate(panels.items()):
        axes[0, column].imshow(panel.permute(1, 2, 0).numpy())
        axes[0, column].set_title(name)
        axes[1, column].imshow(panel[:, y : y + side, x : x + side].permute(1, 2, 0).numpy(), interpolation="nearest")
    for axis in axes.flat:
        axis.set_axis_off()
    save_figure(plot, path)


def _busiest_window(labels: Tensor, side: int) -> tuple[int, int]:
    band = edge_band(labels).float()[None, None]
    stride = side // 8
    density = torch.nn.functional.avg_pool2d(band, side, stride)[0, 0]
    row, column = divmod(int(density.argmax()), density.shape[1])
    return row * stride, column * stride


def _print_table(
    pictures: dict[str, Tensor], image: Tensor, labels: Tensor, results: dict[str, FitResult], title: str
) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("", "PSNR (dB)", "EF-PSNR (dB)", "seconds", title=title)
    for name, picture in pictures.items():
        figures = measure(picture, image, labels)
        seconds = results[name].history[-1].seconds
        table.add_row(name, f"{figures['psnr']:.2f}", f"{figures['ef_psnr']:.2f}", f"{seconds:.1f}")
    Console().print(table)
