"""A fit as a job: its settings in, a row of figures out, of the scene and of its file."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from itertools import product
from typing import Any

from torch import Tensor

from kcgs import FitConfig, FitResult, evaluate, fit
from kcgs.codec import decode, encode, encode_labels
from kcgs.fitting import precompile
from kcgs.functional import ef_psnr, ms_ssim, psnr
from kcgs.rate import quality_for

from . import image_gs
from .images import load_mapped
from .run import Job, Options, Row

QUICK_ITERATIONS = 10
# iterations of the two short fits that measure the time of an iteration
TRIAL_ITERATIONS = (50, 200)
# share of the time by which a fit may miss it
TOLERANCE = 0.12
# metrics of reports, by the names that `kcgs.evaluate` gives them; those of contours begin with ef_
REPORTED: dict[str, Callable[..., Tensor]] = {"psnr": psnr, "ef_psnr": ef_psnr, "ms_ssim": ms_ssim}
# a recipe, and arguments of `fit` that differ from it: plain values, or names of `image_gs.OBJECTS`
Method = tuple[str, dict[str, Any]]
# methods that reports compare in the same time
METHODS: dict[str, Method] = {
    **{name: (name, {}) for name in ("best", "best-baseline", "paper", "gaussian-image", "gaussian-image-clamp")},
    # SSIM in torch takes ten times as long as all else
    "image-gs, L1 alone": ("best", {**image_gs.SETTINGS, "objective": "l1"}),
}


def plan(images: Iterable[str], counts: Sequence[int], methods: dict[str, Method], options: Options) -> list[Job]:
    """List fits."""
    jobs = []
    for image, n, (name, (recipe, settings)) in product(images, counts, methods.items()):
        length = {"iterations": QUICK_ITERATIONS} if options.quick else {}
        job = {"image": image, "n": n, "method": name, "recipe": recipe, "settings": {**settings, **length}}
        jobs.append({**job, **options.image_arguments()})
    return jobs


def measure_fit(
    image: str, n: int, method: str, recipe: str, settings: dict[str, Any], data: str, quick: bool
) -> list[Row]:
    """Fit an image, and measure the scene and its file."""
    pixels, labels = load_mapped(image, data, quick)
    result, seconds = timed_fit(pixels, labels, n, (recipe, settings))
    return [{"image": image, "n": n, "method": method, **measure_result(result, seconds, pixels, labels)}]


def timed_fit(image: Tensor, labels: Tensor, n: int, method: Method) -> tuple[FitResult, float]:
    """Fit an image; return the result and its processor time in seconds, without compilation."""
    recipe, settings = method
    objects = {name: image_gs.OBJECTS[value] for name, value in settings.items() if value in image_gs.OBJECTS}
    config = FitConfig.from_recipe(recipe, **{name: settings[name] for name in settings.keys() - objects.keys()})
    precompile(config)
    start = time.process_time()
    result = fit(image, labels, n, recipe=config, **objects)
    return result, time.process_time() - start


def fit_for(seconds: float, image: Tensor, labels: Tensor, n: int, method: str) -> tuple[FitResult, float]:
    """Fit for about `seconds` of a core: two short fits time an iteration; a fit that misses is repeated."""
    short, long = (timed_fit(image, labels, n, method_of(method, count))[1] for count in TRIAL_ITERATIONS)
    per_iteration = max(long - short, 1e-3) / (TRIAL_ITERATIONS[1] - TRIAL_ITERATIONS[0])
    iterations = max(1, round(TRIAL_ITERATIONS[0] + (seconds - short) / per_iteration))
    result, elapsed = timed_fit(image, labels, n, method_of(method, iterations))
    if abs(elapsed / seconds - 1) > TOLERANCE:
        iterations = max(1, round(iterations * seconds / elapsed))
        result, elapsed = timed_fit(image, labels, n, method_of(method, iterations))
    return result, elapsed


def method_of(name: str, iterations: int | None) -> Method:
    """Return one of METHODS with this number of iterations, or with its own number for None."""
    recipe, settings = METHODS[name]
    return recipe, settings if iterations is None else {**settings, "iterations": iterations}


def measure_result(result: FitResult, seconds: float, image: Tensor, labels: Tensor) -> Row:
    """Measure a fitted scene and its file."""
    scene, regions = result.scene, result.scene.regions
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # NaN: too small for MS-SSIM
        metrics = evaluate(scene, image, labels)
    file = encode(scene, quality=quality_for(metrics["psnr"]))
    decoded = measure_render(decode(file).scene.render(), image, labels)
    contours = None if regions is None or regions.num_regions == 1 else regions.labels
    return {
        "iterations": result.history[-1].iteration, "core_seconds": seconds,
        **{name: metrics[name] for name in REPORTED}, "ssimulacra2": metrics.get("ssimulacra2", math.nan),
        "bytes": len(file), "bpp": 8 * len(file) / image[0].numel(),
        "map_bytes": 0 if contours is None else len(encode_labels(contours)),
        **{f"decoded_{name}": value for name, value in decoded.items()},
    }  # fmt: skip


def measure_render(render: Tensor, image: Tensor, labels: Tensor | None) -> Row:
    """Return the metrics of a render; those of contours where there are labels."""
    row: Row = {}
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # NaN: too small for MS-SSIM
        for name, metric in REPORTED.items():
            if not name.startswith("ef_"):
                row[name] = float(metric(render, image))
            elif labels is not None:
                row[name] = float(metric(render, image, labels))
    return row
