"""How good are scenes of small photos that are rendered large, beside enlarged pixels?"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.nn.functional import avg_pool2d

from kcgs import fit
from kcgs.functional import ef_psnr, psnr

from .core.clocks import milliseconds
from .core.compare import Contest, answer, differences, grouped, losses, means
from .core.figures import Panel, save_lines
from .core.fits import QUICK_ITERATIONS
from .core.images import load_mapped, names
from .core.run import Job, Options, Page, Row, experiment

FACTORS = (2, 4)
# pixels of the small photo per Gaussian
SHARES = (330, 80, 25)
ROUNDS = 3
BAND = 5  # pixels of the small photo
QUANTITIES = ("psnr", "ef_psnr")
SCENE = "scene"
CONTESTS = (Contest(SCENE, "own render, bicubic"), Contest(SCENE, "own render, Lanczos"))
METHOD = f"""Photos are reduced by the means of blocks of pixels, their label maps to the labels of the blocks'
middles, and fitted by `best`. `scene` is `scene.render(size)` at the original size, `own render` the scene's render at
the small size, enlarged by Pillow, and `small photo` all pixels of the reduced photo, enlarged. All are measured
against the original; EF-PSNR is within {BAND} pixels of the small photo of contours, those of the given map on DAVIS,
and on Kodak those found in the original."""


def measure(image: str, group: str, factor: int, share: int, data: str, quick: bool) -> list[Row]:
    """Fit a small photo, and measure what is shown at the original size."""
    pixels, labels = load_mapped(image, data, quick)
    height, width = (side // factor * factor for side in labels.shape)
    pixels, labels = pixels[:, :height, :width].contiguous(), labels[:height, :width].contiguous()
    small = avg_pool2d(pixels, factor)
    small_labels = labels[factor // 2 :: factor, factor // 2 :: factor].contiguous()
    n = round(small_labels.numel() / share)
    scene = fit(small, small_labels, n, iterations=QUICK_ITERATIONS if quick else None).scene
    rows = []
    methods: dict[str, Callable[[], Tensor]] = {SCENE: partial(scene.render, (height, width))}
    for how in ("bicubic", "Lanczos"):
        methods[f"own render, {how}"] = partial(enlarge, scene.render, (height, width), how)
        methods[f"small photo, {how}"] = partial(enlarge, small.clone, (height, width), how)
    times = milliseconds(methods, ROUNDS)
    for method, render in methods.items():
        shown = render()
        row = {"image": image, "group": group, "factor": factor, "n": n, "pixels per Gaussian": share, "method": method}
        row |= {"ms": times[method], "psnr": float(psnr(shown, pixels))}
        if len(labels.unique()) > 1:
            row["ef_psnr"] = float(ef_psnr(shown, pixels, labels, width=BAND * factor))
        rows.append(row)
    return rows


def enlarge(image: Callable[[], Tensor], size: tuple[int, int], how: str) -> Tensor:
    """Make (C, H, W) and enlarge it by Pillow, in floats."""
    planes = [Image.fromarray(plane.numpy()).resize(size[::-1], Image.Resampling[how.upper()]) for plane in image()]
    return torch.from_numpy(np.stack([np.asarray(plane) for plane in planes])).clamp(0, 1)


def jobs(options: Options) -> list[Job]:
    """Fit photos of DAVIS and Kodak at half and a quarter of their size."""
    images = [("DAVIS", "disc")]
    if not options.quick:
        images = [(group, name) for group in ("DAVIS", "Kodak") for name in names(options.folder(), group.lower())]
    listed = [
        {"image": image, "group": group, "factor": factor, "share": share}
        for group, image in images
        for factor in FACTORS
        for share in (SHARES[:1] if options.quick else SHARES)
    ]
    fixed = {"data": str(options.data or ""), "quick": options.quick}
    return [{**job, **fixed} for job in listed]


def run(options: Options) -> None:
    """Measure, and write the report."""
    experiment(__name__, options, jobs, measure, page)


def page(folder: Path, rows: list[Row]) -> Page:
    """Write the report."""
    cases = ["group", "factor", "pixels per Gaussian"]
    panels = [
        Panel(f"{group}, {factor} times the size", of, "pixels per Gaussian", "psnr")
        for (group, factor), of in grouped(rows, ["group", "factor"]).items()
    ]
    save_lines(folder / "enlarge.png", panels, "method", "pixels per Gaussian")
    tables = [differences(rows, CONTESTS, QUANTITIES, cases), means(rows, [*cases, "method"], ("n", *QUANTITIES, "ms"))]
    sentences = " ".join(answer(rows, contest, QUANTITIES, cases) for contest in CONTESTS)
    question = "How good are scenes of small photos that are rendered large?"
    return Page(question, METHOD, sentences, "enlarge.png", tables, losses(rows, CONTESTS, QUANTITIES, cases))
