"""A fit as a job: its settings in, a row of figures out, of the scene and of its file."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from itertools import product
from typing import Any

from torch import Tensor

from kcgs import FitConfig, evaluate, fit
from kcgs.codec import decode, encode, encode_labels
from kcgs.fitting import precompile
from kcgs.functional import ef_psnr, ms_ssim, psnr
from kcgs.rate import quality_for

from .images import load_mapped
from .run import Job, Options, Row

# recipes as published have 50,000 iterations, which take a quarter of an hour per photo on a processor core
PUBLISHED = ("paper", "gaussian-image", "gaussian-image-clamp", "image-gs")
PUBLISHED_ITERATIONS = 2_000
QUICK_ITERATIONS = 10
# of reports, by the names that `kcgs.evaluate` gives them; those of contours begin with ef_
METRICS: dict[str, Callable[..., Tensor]] = {"psnr": psnr, "ef_psnr": ef_psnr, "ms_ssim": ms_ssim}
Method = tuple[str, dict[str, Any]]  # a recipe, and settings that differ from it


def plan(
    images: Iterable[str],
    counts: Sequence[int],
    methods: dict[str, Method],
    options: Options,
    iterations: int = PUBLISHED_ITERATIONS,
) -> list[Job]:
    """List fits; `iterations` are those of the published recipes."""
    jobs = []
    for image, n, (name, (recipe, settings)), seed in product(images, counts, methods.items(), range(options.seeds)):
        length = {"iterations": iterations} if recipe in PUBLISHED else {}
        length = {"iterations": QUICK_ITERATIONS} if options.quick else length
        job = {"image": image, "n": n, "method": name, "recipe": recipe, "settings": {**settings, **length}}
        jobs.append({**job, "seed": seed, "data": str(options.data or ""), "quick": options.quick})
    return jobs


def measure_fit(
    image: str, n: int, method: str, recipe: str, settings: dict[str, Any], seed: int, data: str, quick: bool
) -> list[Row]:
    """Fit, encode, and measure both."""
    pixels, labels = load_mapped(image, data, quick)
    config = FitConfig.from_recipe(recipe, **settings)
    if not quick:
        precompile(config)  # no clock counts compilation
    start = time.process_time()
    result = fit(pixels, labels, n, recipe=config, seed=seed)
    seconds = time.process_time() - start
    scene, regions = result.scene, result.scene.regions
    figures = evaluate(scene, pixels, labels)
    file = encode(scene, quality=quality_for(figures["psnr"]))
    decoded = evaluate(decode(file).scene, pixels, labels)
    stored = None if regions is None or regions.num_regions == 1 else regions.labels
    return [{
        "image": image, "n": n, "method": method, "seed": seed, "iterations": result.history[-1].iteration,
        **{name: figures[name] for name in METRICS}, "ssimulacra2": figures.get("ssimulacra2", math.nan),
        "bytes": len(file), "map_bytes": 0 if stored is None else len(encode_labels(stored)),
        "bpp": 8 * len(file) / pixels[0].numel(), "core_seconds": seconds,
        **{f"decoded_{name}": decoded[name] for name in METRICS},
    }]  # fmt: skip


def measure_render(render: Tensor, image: Tensor, labels: Tensor | None) -> Row:
    """Return the metrics of a render; those of contours where there are labels."""
    figures: Row = {}
    with warnings.catch_warnings():
        # NaN: the image is too small for MS-SSIM
        warnings.simplefilter("ignore", RuntimeWarning)
        for name, metric in METRICS.items():
            if not name.startswith("ef_"):
                figures[name] = float(metric(render, image))
            elif labels is not None:
                figures[name] = float(metric(render, image, labels))
    return figures
