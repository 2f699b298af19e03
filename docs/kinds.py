"""Quality by N and by bytes, on five kinds of images: `python docs/kinds.py DATA` prints the table."""

from __future__ import annotations

import sys
from pathlib import Path
from statistics import fmean

from torch import Tensor
from torch.nn.functional import interpolate

from kcgs import evaluate, fit
from kcgs.data import load_image
from kcgs.data.charts import chart_2x3, chart_pie
from kcgs.rate import fit_bytes
from kcgs.segment import segment

KINDS = {
    "portrait": ("kodim04", "kodim15"),
    "landscape": ("kodim16", "kodim21"),
    "buildings": ("kodim08", "kodim24"),
    "foliage, water": ("kodim13", "kodim14"),
    "flat graphics": ("2x3", "pie"),
}
COUNTS = (300, 1000, 3000)
BYTES = (1000, 3000, 8000)


def read(name: str, data: Path) -> Tensor:
    """Return a chart, or a photo of Kodak's at half its size, (3, H, W)."""
    charts = {"2x3": chart_2x3, "pie": chart_pie}
    if name in charts:
        return charts[name]().image
    photo = load_image(data / "kodak" / f"{name}.png")[None]
    return interpolate(photo, scale_factor=0.5, mode="bilinear", antialias=True)[0].clamp(0, 1)


def measure(image: Tensor) -> list[dict[str, float]]:
    """Return the metrics of each column."""
    labels = segment(image)
    scenes = [fit(image, labels, count).scene for count in COUNTS]
    scenes += [fit_bytes(image, labels, count).scene for count in BYTES]
    return [evaluate(scene, image, visual=False) for scene in scenes]


def main() -> None:
    """Print a row for each kind."""
    print("|".join(["", "image", *(f"N = {n:,}" for n in COUNTS), *(f"{n:,} bytes" for n in BYTES), ""]))
    for kind, names in KINDS.items():
        columns = zip(*(measure(read(name, Path(sys.argv[1]))) for name in names), strict=True)
        cells = [f"{fmean(m['psnr'] for m in c):.1f} / {fmean(m['ms_ssim'] for m in c):.3f}" for c in columns]
        print("|".join(["", kind, *cells, ""]), flush=True)


if __name__ == "__main__":
    main()
