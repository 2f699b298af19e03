"""How good are scenes of small photos that are rendered large?"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from torch import Tensor
from torch.nn.functional import avg_pool2d

from kcgs import fit
from kcgs.functional import ef_psnr, psnr

from .core.clocks import milliseconds
from .core.compare import Comparison, count_wins, differences, losses_table, mean_gain
from .core.figures import Panel, save_lines
from .core.fits import QUICK_ITERATIONS
from .core.images import load_mapped, names, resize
from .core.run import Job, Options, Page, Row
from .core.tables import group_by, means_table

FACTORS = (2, 4)
# pixels of the small photo per Gaussian
SHARES = (330, 80, 25)
ROUNDS = 3
BAND = 5  # width of the edge band, in pixels of the small photo
QUANTITIES = ("psnr", "ef_psnr")
SCENE = "scene"
COMPARISONS = (Comparison(SCENE, "own render, bicubic"), Comparison(SCENE, "own render, Lanczos"))
METHOD = f"""Photos are reduced by the means of blocks of pixels, their label maps to the labels of the blocks'
middles, and fitted by `best`. `scene` is `scene.render(size)` at the original size, `own render` the scene's render
at the small size, enlarged by Pillow, and `small photo` all pixels of the reduced photo, enlarged. All are measured
against the original. Table: PSNR / EF-PSNR in dB; EF-PSNR is within {BAND} pixels of the small photo of contours,
those of the given map on DAVIS, and on Kodak those found in the original."""


def measure(image: str, group: str, factor: int, share: int, data: str, quick: bool) -> list[Row]:
    """Fit a small photo, and measure each enlargement at the original size."""
    pixels, labels = load_mapped(image, data, quick)
    height, width = (side // factor * factor for side in labels.shape)
    pixels, labels = pixels[:, :height, :width].contiguous(), labels[:height, :width].contiguous()
    small = avg_pool2d(pixels, factor)
    small_labels = labels[factor // 2 :: factor, factor // 2 :: factor].contiguous()
    n = round(small_labels.numel() / share)
    scene = fit(small, small_labels, n, iterations=QUICK_ITERATIONS if quick else None).scene
    rows = []
    methods: dict[str, Callable[[], Tensor]] = {SCENE: partial(scene.render, (height, width))}
    for resampling in ("bicubic", "Lanczos"):
        methods[f"own render, {resampling}"] = partial(enlarge, scene.render, (height, width), resampling)
        methods[f"small photo, {resampling}"] = partial(enlarge, small.clone, (height, width), resampling)
    times = milliseconds(methods, ROUNDS)
    for method, render in methods.items():
        enlargement = render()
        row = {"image": image, "group": group, "factor": factor, "n": n, "pixels per Gaussian": share, "method": method}
        row |= {"ms": times[method], "psnr": float(psnr(enlargement, pixels))}
        if len(labels.unique()) > 1:
            row["ef_psnr"] = float(ef_psnr(enlargement, pixels, labels, width=BAND * factor))
        rows.append(row)
    return rows


def enlarge(image: Callable[[], Tensor], size: tuple[int, int], resampling: str) -> Tensor:
    """Make an image and enlarge it."""
    return resize(image(), size, resampling)


def jobs(options: Options) -> list[Job]:
    """List fits of photos of DAVIS and Kodak at half and a quarter of their size."""
    images = [("DAVIS", "disc")]
    if not options.quick:
        images = [(group, name) for group in ("DAVIS", "Kodak") for name in names(options.folder(), group.lower())]
    jobs_of_images = [
        {"image": image, "group": group, "factor": factor, "share": share}
        for group, image in images
        for factor in FACTORS
        for share in (SHARES[:1] if options.quick else SHARES)
    ]
    arguments = options.image_arguments()
    return [{**job, **arguments} for job in jobs_of_images]


def page(folder: Path, rows: list[Row]) -> Page:
    """Write the report."""
    cases = ["group", "factor", "pixels per Gaussian"]
    panels = [
        Panel(f"{group}, {factor} times the size", group_rows, "pixels per Gaussian", "psnr")
        for (group, factor), group_rows in group_by(rows, ["group", "factor"]).items()
    ]
    save_lines(folder / "enlarge.png", panels, "method", "pixels per Gaussian")
    lanczos = COMPARISONS[1]
    changes = [
        " / ".join(f"{mean_gain(group_rows, lanczos, quantity, cases):+.2f}" for quantity in QUANTITIES)
        + f" dB on {group}"
        for (group,), group_rows in group_by(rows, ["group"]).items()
    ]
    wins = [count_wins(rows, lanczos, quantity, cases) for quantity in QUANTITIES]
    photo = mean_gain(rows, Comparison("small photo, bicubic", SCENE), "psnr", cases)
    answer = (
        f"Against its own small render enlarged by Lanczos, a large render has PSNR / EF-PSNR {', '.join(changes)}. "
        f"Its PSNR is higher in {wins[0]} cases, its EF-PSNR in {wins[1]}. The small photo itself, enlarged, has "
        f"{photo:+.2f} dB against the scene."
    )
    table = means_table(rows, ["group", "factor", "method"], "pixels per Gaussian", QUANTITIES)
    losses = losses_table(rows, COMPARISONS, QUANTITIES, cases)
    gains = differences(rows, COMPARISONS, QUANTITIES, cases)
    return Page(answer, "enlarge.png", table, losses, METHOD, gains)
