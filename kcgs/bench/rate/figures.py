"""The experiment's figures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from kcgs.bench.plots import COLORS, figure, save_figure

from .codecs import AVIF, AVIF_PSNR, CODECS, JPEG, WEBP
from .gains import EF_PSNR, PSNR, QUALITIES, gains, pairs
from .points import KCGS, NO_REGIONS, Point

# colour, line and marker of each codec, the same everywhere
_STYLES = {
    KCGS: (COLORS[1], "-", "o"),
    NO_REGIONS: (COLORS[4], "--", "s"),
    JPEG: (COLORS[7], ":", "v"),
    WEBP: (COLORS[2], "-.", "^"),
    AVIF: (COLORS[5], "--", "D"),
    AVIF_PSNR: (COLORS[0], "-", "P"),
}
_QUALITIES = (PSNR, EF_PSNR)


def plot_curves(points: Sequence[Point], path: Path) -> None:
    """Draw PSNR and EF-PSNR over bits a pixel, a row a picture."""
    images = list(dict.fromkeys(p.image for p in points))
    plot, axes = figure(len(images), 2, width=9.5, height=0.8 + 3.0 * len(images))
    rows = axes if len(images) > 1 else [axes]
    for image, row in zip(images, rows, strict=True):
        for axis, quality in zip(row, _QUALITIES, strict=True):
            for codec in _STYLES:
                _draw_curve(axis, [p for p in points if (p.image, p.codec) == (image, codec)], codec, quality)
            axis.set_xscale("log", base=2)
            axis.xaxis.set_major_formatter("{x:g}")
            axis.set(xlabel="bits a pixel", ylabel=f"{QUALITIES[quality][0]} (dB)", title=image)
    handles, labels = rows[0][0].get_legend_handles_labels()
    plot.legend(handles, labels, loc="outside upper center", ncols=len(handles), fontsize=8)
    save_figure(plot, path)


def _draw_curve(axis: Any, points: Sequence[Point], codec: str, quality: str) -> None:
    color, line, marker = _STYLES[codec]
    found = sorted((p.bpp, getattr(p, quality)) for p in points)
    if found:
        x, y = zip(*found, strict=True)
        axis.plot(x, y, line, marker=marker, color=color, markersize=4, linewidth=1.3, label=codec)


def plot_matched(points: Sequence[Point], path: Path) -> None:
    """Draw what each frame gains over each codec at no more bytes, frames by what they gain over AVIF."""
    plot, axes = figure(1, 2, width=11.0, height=4.2)
    rivals = [codec for codec in (*CODECS, NO_REGIONS) if pairs(points, codec)]
    order = gains(pairs(points, AVIF_PSNR if AVIF_PSNR in rivals else rivals[0]), PSNR)
    images = sorted(order, key=lambda image: order[image])
    for axis, quality in zip(axes, _QUALITIES, strict=True):
        axis.axhline(0.0, color="black", linewidth=0.8)
        for codec in rivals:
            color, _, marker = _STYLES[codec]
            found = gains(pairs(points, codec), quality)
            places = [images.index(image) for image in found if image in order]
            axis.plot(places, [v for i, v in found.items() if i in order], marker, color=color, label=codec)
        axis.set_xticks(range(len(images)), images, rotation=60, ha="right", fontsize=8)
        axis.set(ylabel=f"{QUALITIES[quality][0]} gained by kcgs (dB)")
    handles, labels = axes[0].get_legend_handles_labels()
    plot.legend(handles, labels, loc="outside upper center", ncols=len(handles), fontsize=8)
    save_figure(plot, path)
