"""The figures of these pages that kcgs makes: `python docs/figures.py`. The SVGs are made by hand."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from PIL import Image, ImageDraw, ImageFont
from skimage.data import coffee
from torch import Tensor

from kcgs import RegionMap, evaluate, fit, load
from kcgs.editing import recolor_region
from kcgs.functional import region_splat
from kcgs.rate import fit_bytes
from kcgs.segment import segment
from kcgs.zoo import find

IMAGES = Path(__file__).resolve().parent / "images"
SIZE = (160, 240)
SOFTNESS = 6.0  # pixels
NUM_BYTES = 6_000
PART = ((50, 170), (120, 280))  # rows and columns of a scene
COUNTS = (10, 20, 40, 80, 160, 320, 640)
RED = ((200, 120), (280, 215), (225, 250))  # rows and columns of saucer, handle and cup
FRAME_WIDTH = 900
CAPTION_HEIGHT = 34
FRAME_MILLISECONDS = 900


def membership(path: Path) -> None:
    """Render the same two Gaussians without regions, with a hard contour and with a soft one, and a row of each."""
    means = torch.tensor([[80.0, 80.0], [160.0, 80.0]])
    cholesky = torch.tensor([[40.0, 0.0, 40.0]] * 2)
    colors = torch.tensor([[0.95, 0.6, 0.0], [0.2, 0.6, 0.95]])
    ids = torch.tensor([0, 1])
    labels = (torch.arange(SIZE[1]) >= SIZE[1] // 2).long().expand(SIZE).contiguous()
    renders: dict[str, Tensor] = {
        "without regions": region_splat(means, cholesky, colors, size=SIZE),
        "hard contour": region_splat(means, cholesky, colors, ids, RegionMap(labels)),
        "soft contour": region_splat(means, cholesky, colors, ids, RegionMap(labels, softness=SOFTNESS)),
    }
    figure, axes = plt.subplots(
        2, 3, figsize=(9, 3.6), layout="constrained", sharex=True, height_ratios=(2, 1), squeeze=False
    )
    for (above, below), (name, render) in zip(axes.T, renders.items(), strict=True):
        above.imshow(render.clamp(0, 1).permute(1, 2, 0), extent=(0, SIZE[1], SIZE[0], 0))
        above.set_title(name)
        above.set_yticks([])
        above.axhline(80, color="white", linewidth=0.8, linestyle="--")
        for channel, color in enumerate(("#D55E00", "#009E73", "#0072B2")):
            below.plot(torch.arange(SIZE[1]) + 0.5, render[channel, 80], color=color)
        below.set(ylim=(0, 1.1), xlabel="x, pixels")
        below.grid(alpha=0.3)
    axes[1, 0].set_ylabel("R, G, B along\nthe dashed line")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def objectives(path: Path) -> None:
    """Show scikit-image's coffee cup beside files of 6,000 bytes, one for each objective."""
    if find_spec("ssimulacra2") is None:
        raise RuntimeError('the figure needs SSIMULACRA2: pip install -e ".[visual]"')
    image = torch.from_numpy(coffee() / 255).permute(2, 0, 1).float()
    labels = segment(image)
    panels = {"photo": image}
    for name in ("l2", "ms-ssim"):
        result = fit_bytes(image, labels, NUM_BYTES, objective=name)
        metrics = evaluate(result.scene, image, labels)
        figures = (
            f"PSNR {metrics['psnr']:.1f}, EF-PSNR {metrics['ef_psnr']:.1f}, SSIMULACRA2 {metrics['ssimulacra2']:.0f}"
        )
        panels[f'objective="{name}": {figures}'] = result.scene.render()
    figure, axes = plt.subplots(1, 3, figsize=(16, 4), layout="constrained")
    for axis, (title, render) in zip(axes.flat, panels.items(), strict=True):
        axis.imshow(render.clamp(0, 1).permute(1, 2, 0), interpolation="lanczos")
        axis.set_title(title, fontsize=9)
        axis.set_axis_off()
    figure.savefig(path, dpi=110, pil_kwargs={"quality": 85})
    plt.close(figure)


def contours(path: Path) -> None:
    """Show a part of a scene, enlarged six times: its pixels, and the scene itself."""
    scene = load(find("zoo:coffee-1500"))
    size = (6 * scene.size[0], 6 * scene.size[1])
    rows, columns = (slice(6 * begin, 6 * end) for begin, end in PART)
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    pixels = torch.nn.functional.interpolate(scene.render()[None], size, mode="bicubic")[0].clamp(0, 1)
    images = {"its pixels, enlarged (bicubic)": pixels, "rendered at that size": scene.render(size)}
    for axis, (title, image) in zip(axes, images.items(), strict=True):
        axis.imshow(image[:, rows, columns].permute(1, 2, 0))
        axis.set_title(title, fontsize=10)
        axis.set_axis_off()
    figure.savefig(path, dpi=110, pil_kwargs={"quality": 85})
    plt.close(figure)


def growth(path: Path) -> None:
    """Animate fits of more and more Gaussians, without regions and with, and at the end an edit."""
    image = torch.from_numpy(coffee() / 255).permute(2, 0, 1).float()
    labels = segment(image)
    frames = []
    for n in COUNTS:
        scenes = [fit(image, None, n, recipe="best-baseline").scene, fit(image, labels, n).scene]
        captions = (f"{n} Gaussians", f"{n} Gaussians, each in its region")
        frames.append(_frame([scene.render() for scene in scenes], captions))
    without, scene = scenes
    ids = sorted({int(labels[pixel]) for pixel in RED})
    for color in ("royalblue", "seagreen", "gold"):
        edited = recolor_region(scene, ids, color=color)
        frames.append(_frame([without.render(), edited.render()], (captions[0], "regions in another colour")))
    frames[0].save(
        path, save_all=True, append_images=frames[1:], duration=FRAME_MILLISECONDS, loop=0, quality=72, method=6
    )


def _frame(renders: list[Tensor], captions: tuple[str, str]) -> Image.Image:
    """Put two renders side by side, each above its caption."""
    values = (255 * torch.cat(renders, 2).clamp(0, 1)).round().byte().permute(1, 2, 0).numpy()
    pair = Image.fromarray(values)
    pair = pair.resize((FRAME_WIDTH, round(FRAME_WIDTH / pair.width * pair.height)), Image.Resampling.LANCZOS)
    frame = Image.new("RGB", (pair.width, pair.height + CAPTION_HEIGHT), "white")
    frame.paste(pair)
    canvas, font = ImageDraw.Draw(frame), ImageFont.load_default(18)
    for column, caption in zip((1, 3), captions, strict=True):
        middle = (column * pair.width / 4, pair.height + CAPTION_HEIGHT / 2)
        canvas.text(middle, caption, "black", font, anchor="mm")
    return frame


if __name__ == "__main__":
    growth(IMAGES / "growth.webp")
    contours(IMAGES / "contours.jpg")
    objectives(IMAGES / "objectives.jpg")
    membership(IMAGES / "membership.png")
