"""What `kcgs fit-many` does with one image, in whichever process that happens."""

from __future__ import annotations

import hashlib
import math
import time
import warnings
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from .clock import Clock
from .fit import fit_into, measure_scene, read_regions, report_fit
from .options import DEFAULT_GAUSSIANS, FitRequest

if TYPE_CHECKING:
    from kcgs.fitting import FitConfig

# of the note in a scene that says what it was made from
_NOTE = "fit"


class Order(NamedTuple):
    """An image to be fitted, and how."""

    image: Path
    output: Path
    regions: str
    """auto, none, or where the masks are."""
    masks: tuple[Path, ...]
    """The files there that have the image's stem, one where all is well."""
    request: FitRequest
    known: str
    """Which fit the table has metrics of."""


class Outcome(NamedTuple):
    """What the table gets."""

    fit: str
    """Hash of the image, the mask and all settings; of a compressed file its own too."""
    metrics: dict[str, Any] | None
    """None: the file was there, and its metrics are in the table."""
    core_seconds: float
    """Processor time of all that was done for the image, in all threads; NaN: nothing was fitted."""
    warnings: tuple[str, ...]


def fit_one(order: Order) -> Outcome:
    """Fit an image and write its scene or file, unless it is there from the same image and settings."""
    _warm_up(order.request.config, order.regions == "auto")
    # not wall time, which also counts what the machine does for others
    start = time.process_time()
    fit = _fingerprint(order)
    is_there = _is_made(order, fit)
    if is_there and order.known == _mark(order, fit):
        return Outcome(order.known, None, math.nan, ())
    # a warning of one image among many must say which image: the caller does
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        metrics = _measure(order, None if is_there else fit)
    core_seconds = math.nan if is_there else time.process_time() - start
    messages = tuple(str(warning.message) for warning in caught if issubclass(warning.category, UserWarning))
    return Outcome(_mark(order, fit), metrics, core_seconds, messages)


def _measure(order: Order, fit: str | None) -> dict[str, Any]:
    """Fit and measure; where `fit` is None, only measure: the metrics were lost with the process that had them."""
    from kcgs import load
    from kcgs.data import load_image

    request = order.request._replace(clock=Clock(order.request.config.max_seconds, time.perf_counter()))
    image = load_image(order.image)
    labels = read_regions(_source(order), image)
    if fit is None:
        report = measure_scene(load(order.output), image, labels, order.output, order.output.stat().st_size, math.nan)
        target = order.request.config.target_psnr
        return {**report, "stop_reason": "", "target_reached": None if target is None else report["psnr"] >= target}
    pixels = image[0].numel()
    if (request.num_gaussians or 0) > pixels:
        warnings.warn(f"{pixels} Gaussians in place of {request.num_gaussians}: it has no more pixels", stacklevel=2)
        request = request._replace(num_gaussians=pixels)
    fitted = fit_into(order.output, image, labels, request, notes={_NOTE: fit})
    became = fitted.result.regions
    if order.masks and became is not None and became.kept == 1 < became.given and became.dropped != "recipe":
        warnings.warn(f"regions: {became}", stacklevel=2)
    return report_fit(fitted, image, labels, order.output, request)


def _source(order: Order) -> str:
    if order.regions in ("auto", "none"):
        return order.regions
    if len(order.masks) != 1:
        found = ", ".join(path.name for path in order.masks) or "none"
        raise ValueError(f"{order.regions} must hold one mask {order.image.stem}.*; found {found}")
    return str(order.masks[0])


def _fingerprint(order: Order) -> str:
    request, source = order.request, _source(order)
    settings = (
        request.config.model_dump_json(),
        request.num_gaussians or DEFAULT_GAUSSIANS,
        request.target_bytes,
        order.output.suffix,
        request.seed,
    )
    digest = hashlib.sha256(repr(settings).encode())
    digest.update(order.image.read_bytes())
    digest.update(Path(source).read_bytes() if order.masks else source.encode())
    return digest.hexdigest()[:20]


def _is_made(order: Order, fit: str) -> bool:
    from kcgs import load

    if order.output.suffix == ".kcgs":
        return order.output.is_file() and order.known == _mark(order, fit)
    try:
        return load(order.output).metadata.get(_NOTE) == fit
    except (FileNotFoundError, ValueError):
        return False


def _mark(order: Order, fit: str) -> str:
    """Return what the table says of an output: a compressed file has no notes, and is known by its bytes."""
    if order.output.suffix != ".kcgs":
        return fit
    return f"{fit}-{hashlib.sha256(order.output.read_bytes()).hexdigest()[:8]}"


@lru_cache(maxsize=4)
def _warm_up(config: FitConfig, segments: bool) -> None:
    """Load and compile what a worker needs once, so that no image's cost counts it."""
    import torch

    from kcgs import GaussianField, Scene
    from kcgs.fitting.warm_up import warm_up

    warm_up(config)
    # as large as MS-SSIM needs
    ramp = torch.linspace(0.0, 1.0, 192).expand(3, 192, 192)
    image = torch.where(ramp > 0.4, 0.2 * ramp, 0.5 + 0.5 * ramp)
    labels = read_regions("auto" if segments else "none", image)
    measure_scene(Scene(GaussianField.random(8, (192, 192), seed=0)), image, labels, Path(), 0)
