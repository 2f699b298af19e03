"""The command demo: one photo as two files of equal size, without and with regions."""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from .commands import app

if TYPE_CHECKING:
    from PIL.Image import Image
    from torch import Tensor

TARGET_BYTES = 4000
TITLES = {"baseline": "ordinary 2D Gaussians", "contour-aware": "kcgs: contour-aware"}
# close-ups of contours: top, left and side as shares of the photo's side
CLOSE_UPS = ((0.24, 0.36, 0.2), (0.42, 0.5, 0.2))
# side of a column of the comparison, and the margin around it, in pixels
SIDE = 512
GAP = 12
DETAIL_SIDE = (SIDE - GAP) // 2
# height of the text above a column, in pixels
HEADER = 136


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

    typer.echo(f"fitting a photo to {TARGET_BYTES:,} bytes twice, without and with regions: about a minute", err=True)
    precompile(FitConfig.from_recipe("best"))  # so that seconds do not include compilation
    image = torch.from_numpy(astronaut()).permute(2, 0, 1).float() / 255
    compare(output, image, TARGET_BYTES, progress=True)


def compare(output: Path, image: Tensor, target_bytes: int, **settings: Any) -> None:
    """Fit a square image to a number of bytes, twice; `settings` are those of `fit_bytes`."""
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
    table = Table("", "PSNR (dB)", "EF-PSNR (dB)", "seconds", "bytes", title=f"At most {target_bytes:,} bytes")
    for (name, title), regions in zip(TITLES.items(), (None, labels), strict=True):
        start = time.perf_counter()
        result = fit_bytes(image, regions, target_bytes, objective="l2", **settings)
        seconds = time.perf_counter() - start
        (output / f"{name}.kcgs").write_bytes(result.data)
        save_image(output / f"{name}.png", result.scene.render())
        with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # MS-SSIM is not shown
            metrics = evaluate(result.scene, image, labels, with_ssimulacra2=False)
        psnr, ef_psnr, size = f"{metrics['psnr']:.2f}", f"{metrics['ef_psnr']:.2f}", f"{len(result.data):,}"
        table.add_row(name, psnr, ef_psnr, f"{seconds:.1f}", size)
        lines = f"{size} bytes", f"PSNR {psnr} dB, EF-PSNR {ef_psnr} dB"
        panels.append(Panel(title, lines, result.scene.render()))
    compose(panels).save(output / "comparison.png")
    Console().print(table)
    typer.echo(f"images and files in {output}/")


def compose(panels: Sequence[Panel]) -> Image:
    """Lay panels side by side."""
    from PIL import Image

    columns = [draw_column(panel) for panel in panels]
    canvas = Image.new("RGB", (len(columns) * (SIDE + GAP) + GAP, columns[0].height), "white")
    for index, column in enumerate(columns):
        canvas.paste(column, (GAP + index * (SIDE + GAP), 0))
    return canvas


def draw_column(panel: Panel) -> Image:
    """Write a title and two lines above a square image, and two framed close-ups below it; pixels are not smoothed."""
    from PIL import Image, ImageDraw, ImageFont

    from kcgs.plots import COLORS

    column = Image.new("RGB", (SIDE, HEADER + SIDE + GAP + DETAIL_SIDE + GAP), "white")
    pen = ImageDraw.Draw(column)
    for text, middle, font_size in zip((panel.title, *panel.lines), (30, 74, 108), (36, 26, 26), strict=True):
        pen.text((SIDE / 2, middle), text, fill="black", font=ImageFont.load_default(font_size), anchor="mm")
    pixels = (255 * panel.image.clamp(0, 1)).round().byte().permute(1, 2, 0).numpy()
    image = Image.fromarray(pixels).resize((SIDE, SIDE), Image.Resampling.NEAREST)
    column.paste(image, (0, HEADER))
    for index, (y, x, share) in enumerate(CLOSE_UPS):
        left, top, right, bottom = (round(SIDE * place) for place in (x, y, x + share, y + share))
        detail = image.crop((left, top, right, bottom)).resize((DETAIL_SIDE, DETAIL_SIDE), Image.Resampling.NEAREST)
        corner = index * (DETAIL_SIDE + GAP), HEADER + SIDE + GAP
        column.paste(detail, corner)
        border = (*corner, corner[0] + DETAIL_SIDE - 1, corner[1] + DETAIL_SIDE - 1)
        pen.rectangle(border, outline=COLORS[index], width=5)
        pen.rectangle((left, HEADER + top, right, HEADER + bottom), outline=COLORS[index], width=3)
    return column
