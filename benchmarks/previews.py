"""How good are previews of a few hundred bytes, beside those of other codecs?"""

from __future__ import annotations

import math
import shutil
import subprocess
import time
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from skimage.color import deltaE_ciede2000, rgb2lab
from torch import Tensor
from torch.nn.functional import avg_pool2d

from kcgs.data import load_image, save_image
from kcgs.functional import psnr, ssimulacra2
from kcgs.rate import fit_bytes

from .core.codecs import best_file
from .core.compare import Comparison, count_wins, differences, losses_table, mean_gain
from .core.figures import save_rows
from .core.fits import QUICK_ITERATIONS
from .core.images import load, names, resize
from .core.run import Job, Options, Page, Row
from .core.tables import group_by, means_table

BYTES = (200, 400, 1_000)
FIGURE_BYTES = 1_000
SIDE = 512  # longer side of a photo, in pixels
OURS, HASH = "kcgs", "ThumbHash"
OTHERS = ("WebP", "AVIF")
HASH_SIDE = 100  # longest side that ThumbHash takes, in pixels
REDUCTIONS = (1, 2, 3, 4, 6, 8, 12, 16)
QUANTITIES = ("delta_e", "ssimulacra2", "butteraugli", "psnr")
COMPARISONS = tuple(Comparison(OURS, other) for other in (*OTHERS, HASH))
CASES = ["target_bytes"]
# the first eight photos with even numbers that are not upright; settings were tuned on odd numbers
FIGURE = ("disc", *(f"kodim{number:02}" for number in (2, 6, 8, 12, 14, 16, 20, 22)))
FIGURE_HEIGHT = 170  # approximate height of a photo in the figure, in pixels
GAP = 12  # gap between photos, in pixels
METHOD = f"""Kodak's photos, reduced to {SIDE} pixels on the longer side. `kcgs` is `fit_bytes` with its default
settings, without a map. WebP (method 6) and AVIF (speed 4) code the photo, or the photo reduced to one of
{len(REDUCTIONS) - 1} sizes from a half to a sixteenth of each side and enlarged bicubically: of all files of at most
so many bytes the one with the highest SSIMULACRA2. Where a codec has no file as small on some photos, the number of
the others is behind their mean. ThumbHash has 21 bytes whatever the budget, and is enlarged
bicubically from 32 pixels. deltaE 2000 is the mean over pixels. Butteraugli is its largest distance, by Debian's
package of that name, of 2017; other versions have other scales. A file of the other codecs, at a size that wins,
takes less than 0.5 s. Table: deltaE 2000 / SSIMULACRA2 / PSNR in dB. The figure shows eight photos at
{FIGURE_BYTES:,} bytes: the photo, kcgs, and WebP or AVIF, whichever has the higher SSIMULACRA2."""


def measure(image: str, method: str, target_bytes: int, folder: str, data: str, quick: bool) -> list[Row]:
    """Make a preview and measure it; write it if it is in the figure."""
    photo = load(image, data, quick).image
    height, width = photo.shape[1:]
    scale = SIDE / max(height, width)
    if scale < 1:
        photo = resize(photo, (round(scale * height), round(scale * width)), "lanczos")
    start = time.process_time()
    if method == OURS:
        file = fit_bytes(photo, None, target_bytes, iterations=QUICK_ITERATIONS if quick else None)
        name, size, render = OURS, len(file.data), file.scene.render()
    elif method == HASH:
        name, (size, render) = HASH, thumbhash(photo)
    elif best := best_file([method], photo, target_bytes, REDUCTIONS):
        name, size, render = best.name, len(best.data), best.render
    else:
        return []
    row = {"image": image, "target_bytes": target_bytes, "method": method, "file": name, "bytes": size}
    row |= {"core_seconds": time.process_time() - start} if method == OURS else {}
    row["psnr"] = float(psnr(render, photo))
    colors = (rgb2lab(values.clamp(0, 1).permute(1, 2, 0).numpy()) for values in (photo, render))
    row |= {"delta_e": float(deltaE_ciede2000(*colors).mean()), "ssimulacra2": float(ssimulacra2(render, photo))}
    if image in FIGURE and target_bytes == FIGURE_BYTES:
        Path(folder).mkdir(parents=True, exist_ok=True)
        save_image(Path(folder, f"{image}-{method}.png"), torch.cat([photo, render.clamp(0, 1)], 2))
    return [{**row, "butteraugli": butteraugli(render, photo)}]


def thumbhash(image: Tensor) -> tuple[int, Tensor]:
    """Return the bytes of an image's ThumbHash, and the decoded image."""
    from fast_thumbhash import rgba_to_thumb_hash, thumb_hash_to_rgba

    height, width = image.shape[1:]
    scale = HASH_SIDE / max(height, width)
    small = resize(image, (round(scale * height), round(scale * width)), "lanczos")
    pixels = (255 * torch.cat([small, torch.ones_like(small[:1])])).round().byte().permute(1, 2, 0)
    data = bytes(rgba_to_thumb_hash(small.shape[2], small.shape[1], pixels.numpy().tobytes()))
    small_width, small_height, values = thumb_hash_to_rgba(data)
    decoded = torch.tensor(list(values)).reshape(small_height, small_width, 4)[..., :3].permute(2, 0, 1) / 255
    return len(data), resize(decoded, (height, width), "bicubic")


def butteraugli(render: Tensor, image: Tensor) -> float:
    """Run the command `butteraugli`; return NaN if it is not installed."""
    if shutil.which("butteraugli") is None:
        return math.nan
    with TemporaryDirectory() as folder:
        paths = [Path(folder, name) for name in ("image.png", "render.png")]
        for path, values in zip(paths, (image, render), strict=True):
            save_image(path, values.clamp(0, 1))
        return float(subprocess.run(["butteraugli", *paths], capture_output=True, check=True, text=True).stdout)


def jobs(options: Options) -> list[Job]:
    """List previews of Kodak's photos."""
    images = ["disc"] if options.quick else names(options.folder(), "kodak")
    methods = [OURS, *OTHERS, *([HASH] if find_spec("fast_thumbhash") else [])]
    arguments = {"folder": str(options.output / "runs"), **options.image_arguments()}
    return [
        {"image": image, "method": method, "target_bytes": size, **arguments}
        for image in images
        for method in methods
        for size in ((FIGURE_BYTES,) if options.quick else BYTES)
    ]


def page(folder: Path, rows: list[Row]) -> Page:
    """Write the report; if the images of the run are gone, keep the old figure."""
    rows = sorted(rows, key=lambda row: row["target_bytes"])
    figures: list[list[Tensor]] = []
    for (image,), files in group_by(rows, ["image"]).items():
        others = [row for row in files if row["method"] in OTHERS and row["target_bytes"] == FIGURE_BYTES]
        best = max(others, key=lambda row: row["ssimulacra2"], default={"method": ""})
        paths = [folder / "runs" / f"{image}-{method}.png" for method in (OURS, best["method"])]
        if all(path.exists() for path in paths):
            pairs = [load_image(path) for path in paths]
            ours, other = (avg_pool2d(pair, max(1, pair.shape[1] // FIGURE_HEIGHT)) for pair in pairs)
            figures.append([ours, other[..., other.shape[2] // 2 :], torch.ones(3, ours.shape[1], GAP)])
    if figures:
        lines = [[image for figure in figures[i : i + 2] for image in figure] for i in range(0, len(figures), 2)]
        save_rows(folder / "previews.jpg", lines)
    webp = COMPARISONS[0]
    colors = {
        size: f"{mean_gain(group, webp, 'delta_e'):+.2f} at {size:,} bytes"
        for (size,), group in group_by(rows, CASES).items()
        if webp.gains(group, "delta_e", [])
    }
    answer = (
        "Beside the best WebP of so many bytes, previews have a lower colour difference in "
        f"{count_wins(rows, webp, 'delta_e', CASES)} files, by deltaE {', '.join(colors.values())}. SSIMULACRA2 is "
        f"higher in {count_wins(rows, webp, 'ssimulacra2', CASES)}."
    )
    table = means_table(rows, ["method"], "target_bytes", ("delta_e", "ssimulacra2", "psnr"))
    losses = losses_table(rows, COMPARISONS, QUANTITIES, CASES)
    gains = differences(rows, COMPARISONS, QUANTITIES, CASES)
    return Page(answer, "previews.jpg", table, losses, METHOD, gains)
