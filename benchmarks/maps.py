"""What do label maps gain that are found in the image itself?"""

from __future__ import annotations

import math
import time
from pathlib import Path

from torch import Tensor

from kcgs import Scene, fit
from kcgs.codec import decode, encode
from kcgs.functional import ef_psnr, psnr
from kcgs.rate import quality_for
from kcgs.segment import segment

from .core.compare import Contest, answer, differences, losses, means
from .core.figures import Panel, save_lines
from .core.fits import QUICK_ITERATIONS
from .core.images import load, names
from .core.run import Job, Options, Page, Row, experiment

COUNTS = (400, 1_000)
# with every fourth image, at the first of the counts
OTHERS = ("felzenszwalb", "slic", "watershed", "kmeans")
OTHERS_STRIDE = 4
QUANTITIES = ("psnr", "ef_psnr")
CONTESTS = (Contest("map", "no map"), Contest("map", "no map, equal bits"))
METHOD = """No map is given: each is what `kcgs.segment.segment(image, source)` finds. A fit of `best` with the map
stands beside `best-baseline` with as many Gaussians, and beside the baseline with as many Gaussians as the bytes of
the first file buy, its map included. EF-PSNR is within 5 pixels of the contours of the map that the fit ends with; a
map without contours has none. Figures at equal bits, and those of the map beside it, are of decoded files."""


def measure(image: str, n: int, sources: list[str], data: str, quick: bool) -> list[Row]:
    """Fit with each source's map and without."""
    pixels = load(image, data, quick).image
    iterations = QUICK_ITERATIONS if quick else None
    alone = fit(pixels, None, n, recipe="best-baseline", iterations=iterations).scene
    size, rows = len(_file(alone, pixels)), []
    for source in sources:
        start = time.process_time()
        labels = segment(pixels, source)
        seconds = time.process_time() - start
        ours = fit(pixels, labels, n, recipe="best", iterations=iterations).scene
        file = _file(ours, pixels)
        equal_n = max(1, round(n * len(file) / size))
        equal = fit(pixels, None, equal_n, recipe="best-baseline", iterations=iterations).scene
        equal_file = _file(equal, pixels)
        regions = ours.regions
        band = None if regions is None or regions.num_regions == 1 else regions.labels
        for method, scene, data_bytes, count in (
            ("map", ours, file, n), ("no map", alone, b"", n), ("no map, equal bits", equal, equal_file, equal_n),
        ):  # fmt: skip
            render = decode(data_bytes).scene.render() if method != "no map" else scene.render()
            figures = {"psnr": float(psnr(scene.render(), pixels)), "decoded_psnr": float(psnr(render, pixels))}
            if band is not None:
                figures["ef_psnr"] = float(ef_psnr(scene.render(), pixels, band))
                figures["decoded_ef_psnr"] = float(ef_psnr(render, pixels, band))
            rows.append({
                "image": image, "n": n, "source": source, "method": method, "gaussians": count, **figures,
                "bytes": len(data_bytes) or size, "regions": 1 if regions is None else regions.num_regions,
                "map_seconds": seconds if method == "map" else math.nan,
            })  # fmt: skip
    return rows


def _file(scene: Scene, image: Tensor) -> bytes:
    return encode(scene, quality=quality_for(float(psnr(scene.render(), image))))


def jobs(options: Options) -> list[Job]:
    """Fit the photos of BSDS."""
    images = ["astronaut"] if options.quick else names(options.folder(), "bsds")
    listed = []
    for index, image in enumerate(images):
        for n in (60,) if options.quick else COUNTS:
            others = OTHERS if n != COUNTS[-1] and index % OTHERS_STRIDE == 0 else ()
            job = {"image": image, "n": n, "sources": ["auto", *others]}
            listed.append({**job, "data": str(options.data or ""), "quick": options.quick})
    return listed


def run(options: Options) -> None:
    """Measure, and write the report."""
    experiment(__name__, options, jobs, measure, page)


def page(folder: Path, rows: list[Row]) -> Page:
    """Write the report."""
    cases = ["source", "n"]
    first, second = CONTESTS
    decoded = tuple(f"decoded_{name}" for name in QUANTITIES)
    ranked = []
    for contest, quantities in ((first, QUANTITIES), (second, decoded)):
        for quantity in quantities:
            for (source, n), gain in contest.gains(rows, quantity, cases).items():
                fixed = {"source": f"{source}, N = {n:,}", "which": contest}
                values = enumerate(sorted(gain.values.values()), 1)
                ranked += [{**fixed, "% of images": 100 * i / len(gain.values), quantity: value} for i, value in values]
    panels = [
        Panel(
            " - ".join(contest),
            [row for row in ranked if row["which"] == contest],
            "% of images",
            q,
            ("linear", "linear"),
        )
        for contest, quantities in ((first, QUANTITIES), (second, decoded))
        for q in quantities
    ]
    save_lines(folder / "maps.png", panels, "source", "% of images", marker=False)
    tables = [differences(rows, [first], QUANTITIES, cases), differences(rows, [second], decoded, cases)]
    tables.append(means(rows, ["source", "n", "method"], ("gaussians", "regions", "bytes", "map_seconds")))
    automatic = [row for row in rows if row["source"] == "auto"]
    text = f"{answer(automatic, first, QUANTITIES, cases)} {answer(automatic, second, decoded, cases)}"
    lost = losses(rows, [first], QUANTITIES, cases), losses(rows, [second], decoded, cases)
    question = "What do label maps gain that are found in the image itself?"
    return Page(question, METHOD, text, "maps.png", tables, "\n\n".join(filter(None, lost)))
