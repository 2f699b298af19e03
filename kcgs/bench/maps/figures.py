"""The experiment's figure."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from kcgs.bench.plots import COLORS, figure, save_figure

from .gains import MOST_LOSS
from .trials import AUTO, OTHERS, Result

_MARKERS = ("o", "s", "^", "D", "v")


def plot_gains(results: Sequence[Result], path: Path) -> None:
    """Draw the gain in PSNR against the bytes of the map, a dot an image, a panel each N."""
    counts = sorted({r.n for r in results})
    plot, axes = figure(1, len(counts), width=1.0 + 4.6 * len(counts), height=4.4)
    for axis, n in zip(axes if len(counts) > 1 else [axes], counts, strict=True):
        _draw(axis, [r for r in results if r.n == n])
        axis.set(xlabel="bytes of the final map", ylabel="PSNR gained (dB)", title=f"N = {n:,}")
        axis.set_xlim(left=0)
        axis.legend(fontsize=7)
    save_figure(plot, path)


def _draw(axis: Any, results: Sequence[Result]) -> None:
    axis.axhline(0.0, color="black", linewidth=0.8)
    axis.axhline(-MOST_LOSS, color="black", linewidth=0.8, linestyle=":", label="most that an image may lose")
    for index, source in enumerate((AUTO, *OTHERS)):
        found = [r for r in results if r.source == source]
        if found:
            axis.plot(
                [r.map_bytes for r in found],
                [r.gain for r in found],
                _MARKERS[index],
                color=COLORS[index],
                markersize=6 if source == AUTO else 5,
                markeredgecolor="white",
                markeredgewidth=0.5,
                label=source,
            )
