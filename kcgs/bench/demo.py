"""The first look: one photo, ordinary Gaussians beside contour-aware ones: `kcgs bench demo`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import torch

from kcgs.data import colorize_labels, save_image, save_labels
from kcgs.evaluation import measure
from kcgs.fitting import FitConfig, FitResult, fit, warm_up
from kcgs.plots import COLORS, history_figure, save_figure
from kcgs.scene import load
from kcgs.segment import segment

from .core.images import photo
from .core.options import Options
from .core.registry import experiment

if TYPE_CHECKING:
    from PIL.Image import Image
    from torch import Tensor

NUM_GAUSSIANS = 400
QUICK_STRIDE, QUICK_GAUSSIANS, QUICK_ITERATIONS = 4, 60, 20
RECIPES = {"baseline": "best-baseline", "contour-aware": "best"}
TITLES = {"baseline": "ordinary 2D Gaussians", "contour-aware": "kcgs: contour-aware"}
# close-ups of contours: top, left and side as shares of the photo's side
CLOSE_UPS = ((0.27, 0.39, 0.25), (0.29, 0.66, 0.25))


class Panel(NamedTuple):
    """A column of the comparison."""

    title: str
    lines: tuple[str, str]
    image: Tensor


@experiment()
def run(output: Path, options: Options) -> None:
    """Fit scikit-image's astronaut twice; write images, scenes, comparison.png and error-against-time.png."""
    from rich.console import Console
    from rich.table import Table

    image, count = photo("astronaut"), NUM_GAUSSIANS
    if options.quick:
        image, count = torch.nn.functional.avg_pool2d(image, QUICK_STRIDE), QUICK_GAUSSIANS
    labels = segment(image)
    save_image(output / "original.png", image)
    save_image(output / "regions.png", colorize_labels(labels))
    save_labels(output / "labels.png", labels)
    settings = {"iterations": QUICK_ITERATIONS} if options.quick else {}
    results: dict[str, FitResult] = {}
    panels = [Panel("original", (f"{image.shape[2]} x {image.shape[1]} pixels", ""), image)]
    table = Table("", "PSNR (dB)", "EF-PSNR (dB)", "seconds", "bytes", title=f"{count} Gaussians")
    for name, recipe in RECIPES.items():
        config = FitConfig.from_recipe(recipe, **settings)
        if not options.quick:
            warm_up(config)  # the clock counts no compilation
        results[name] = result = fit(image, labels, count, recipe=config, progress=True)
        scene = result.scene
        scene.save(output / f"{name}.safetensors")
        size = scene.save(output / f"{name}.kcgs")
        rendered = load(output / f"{name}.kcgs").render()  # what so many bytes give
        save_image(output / f"{name}.png", rendered)
        figures = measure(rendered, image, labels)
        psnr, ef_psnr = f"{figures['psnr']:.2f}", f"{figures['ef_psnr']:.2f}"
        table.add_row(name, psnr, ef_psnr, f"{result.history[-1].seconds:.1f}", f"{size:,}")
        parts = f"{len(scene)} Gaussians" + ("" if scene.regions is None else " and contours")
        lines = f"{parts}, {size / 1e3:.1f} kB", f"PSNR {psnr} dB, EF-PSNR {ef_psnr} dB"
        panels.append(Panel(TITLES[name], lines, rendered))
    histories = {name: result.history for name, result in results.items()}
    save_figure(history_figure(histories), output / "error-against-time.png")
    compose(panels).save(output / "comparison.png")
    Console().print(table)
    Console().print(f"images and scenes in {output}/")


def compose(panels: Sequence[Panel], *, side: int = 512, gap: int = 12) -> Image:
    """Lay out columns of a title, two lines, a square image and two close-ups of it, no pixel smoothed."""
    from PIL import Image, ImageDraw, ImageFont

    top, close = 136, (side - gap) // 2
    size = len(panels) * (side + gap) + gap, top + side + gap + close + gap
    canvas = Image.new("RGB", size, "white")
    pen = ImageDraw.Draw(canvas)
    for column, panel in enumerate(panels):
        left = gap + column * (side + gap)
        for text, height, font_size in zip((panel.title, *panel.lines), (30, 74, 108), (36, 26, 26), strict=True):
            font = ImageFont.load_default(font_size)
            pen.text((left + side / 2, height), text, fill="black", font=font, anchor="mm")
        pixels = (255 * panel.image.clamp(0, 1)).round().byte().permute(1, 2, 0).numpy()
        image = Image.fromarray(pixels).resize((side, side), Image.Resampling.NEAREST)
        canvas.paste(image, (left, top))
        for index, (y, x, share) in enumerate(CLOSE_UPS):
            box = round(side * x), round(side * y), round(side * (x + share)), round(side * (y + share))
            corner = left + index * (close + gap), top + side + gap
            canvas.paste(image.crop(box).resize((close, close), Image.Resampling.NEAREST), corner)
            pen.rectangle((*corner, corner[0] + close - 1, corner[1] + close - 1), outline=COLORS[index], width=5)
            frame = (left + box[0], top + box[1], left + box[2], top + box[3])
            pen.rectangle(frame, outline=COLORS[index], width=3)
    return canvas
