"""The first look: one photo as two files of equal bytes, without and with regions."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from .common import app

if TYPE_CHECKING:
    from PIL.Image import Image
    from torch import Tensor

NUM_BYTES = 4000
TITLES = {"baseline": "ordinary 2D Gaussians", "contour-aware": "kcgs: contour-aware"}
# close-ups of contours: top, left and side as shares of the photo's side
CLOSE_UPS = ((0.24, 0.36, 0.2), (0.42, 0.5, 0.2))


class Panel(NamedTuple):
    """A column of the comparison."""

    title: str
    lines: tuple[str, str]
    image: Tensor


@app.command()
def demo(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for images and files.")] = Path("demo"),
) -> None:
    """Fit scikit-image's astronaut to 4,000 bytes, without and with regions; write images, files, comparison.png."""
    import torch
    from skimage.data import astronaut

    from kcgs.fitting import FitConfig, precompile

    precompile(FitConfig.from_recipe("best"))  # the clock counts no compilation
    image = torch.from_numpy(astronaut()).permute(2, 0, 1).float() / 255
    run(output, image, NUM_BYTES, progress=True)


def run(output: Path, image: Tensor, num_bytes: int, **settings: Any) -> None:
    """Fit a square image to so many bytes, twice; `settings` are those of `fit_bytes`."""
    from rich.console import Console
    from rich.table import Table

    from kcgs import evaluate
    from kcgs.data import colorize_labels, save_image, save_labels
    from kcgs.rate import fit_bytes
    from kcgs.segment import segment

    output.mkdir(parents=True, exist_ok=True)
    labels = segment(image)
    save_image(output / "original.png", image)
    save_image(output / "regions.png", colorize_labels(labels))
    save_labels(output / "labels.png", labels)
    panels = [Panel("original", (f"{image.shape[2]} x {image.shape[1]} pixels", ""), image)]
    table = Table("", "PSNR (dB)", "EF-PSNR (dB)", "seconds", "bytes", title=f"At most {num_bytes:,} bytes")
    for (name, title), regions in zip(TITLES.items(), (None, labels), strict=True):
        start = time.perf_counter()
        result = fit_bytes(image, regions, num_bytes, **settings)
        seconds = time.perf_counter() - start
        (output / f"{name}.kcgs").write_bytes(result.data)
        save_image(output / f"{name}.png", result.scene.render())
        figures = evaluate(result.scene, image, labels, visual=False)
        psnr, ef_psnr, size = f"{figures['psnr']:.2f}", f"{figures['ef_psnr']:.2f}", f"{len(result.data):,}"
        table.add_row(name, psnr, ef_psnr, f"{seconds:.1f}", size)
        lines = f"{size} bytes", f"PSNR {psnr} dB, EF-PSNR {ef_psnr} dB"
        panels.append(Panel(title, lines, result.scene.render()))
    compose(panels).save(output / "comparison.png")
    Console().print(table)
    typer.echo(f"images and files in {output}/")


def compose(panels: Sequence[Panel], *, side: int = 512, gap: int = 12) -> Image:
    """Lay out columns of a title, two lines, a square image and two close-ups of it, no pixel smoothed."""
    from PIL import Image, ImageDraw, ImageFont

    from kcgs.plots import COLORS

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
