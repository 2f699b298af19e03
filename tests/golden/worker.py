"""The cases of one tree: a process reads requests and writes answers, as lines of JSON.

compare.py runs this file on the tree of another commit, too, so it calls public names and the golden cases alone.
"""

from __future__ import annotations

import functools
import json
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import torch

from benchmarks.core.images import load
from benchmarks.core.scenes import scene_of
from kcgs import fit
from kcgs.functional import ms_ssim, psnr, region_splat
from kcgs.rate import fit_bytes
from tests.golden import record

# a splat takes milliseconds, so it is called for so long, and the fastest call counts; a fit is called once
LEAST_SECONDS = 1.0


class Timed(NamedTuple):
    """An action to time, and what tells how good its result is."""

    action: Callable[[], Any]
    quality: Callable[[Any], str] = lambda _: ""


def fit_case(image_name: str, num_gaussians: int, data: str) -> Timed:
    image, labels = load(image_name, data)
    return Timed(
        lambda: fit(image, labels, num_gaussians),
        lambda result: f"{float(psnr(result.scene.render(), image)):.3f} dB",
    )


def file_case(image_name: str, target_bytes: int, data: str) -> Timed:
    image, _ = load(image_name, data)
    return Timed(
        lambda: fit_bytes(image, None, target_bytes),
        lambda result: f"{len(result.data)} B, {float(ms_ssim(result.scene.render(), image)):.4f}",
    )


def splat_case(scene_name: str, backward: bool, _: str | None) -> Timed:
    scene = scene_of(scene_name)
    f = scene.field

    def splat() -> None:
        with torch.set_grad_enabled(backward):
            image = region_splat(f.means, f.cholesky, f.colors, f.region_ids, scene.regions, size=scene.size)
        if backward:
            image.square().mean().backward()

    return Timed(splat)


DATA_CASES: dict[str, Callable[..., Timed]] = {
    "time/fit-dog-1250": partial(fit_case, "dog", 1_250),
    "time/fit-dog-7500": partial(fit_case, "dog", 7_500),
    "time/fit-kodim05-10000": partial(fit_case, "kodim05", 10_000),
    "time/file-kodim05-1000": partial(file_case, "kodim05", 1_000),
    "time/file-kodim05-8000": partial(file_case, "kodim05", 8_000),
}
SPLATS = {
    f"time/{workload}-{contours}-{name}": partial(splat_case, f"{workload} {contours}", backward)
    for workload in ("W1", "W2")
    for contours in ("hard", "soft")
    for name, backward in {"forward": False, "both": True}.items()
}


@functools.cache
def make_case(name: str, data: str | None) -> Timed:
    return (DATA_CASES | SPLATS)[name](data)


def time_case(name: str, data: str | None) -> tuple[float, float, str]:
    """Return the seconds of the fastest call, those of all cores together, and how good its result is."""
    action, quality = make_case(name, data)
    times: list[tuple[float, float]] = []
    while sum(seconds for seconds, _ in times) < LEAST_SECONDS:
        start, cpu_start = time.perf_counter(), time.process_time()
        result = action()
        times.append((time.perf_counter() - start, time.process_time() - cpu_start))
    seconds, cpu_seconds = map(min, zip(*times, strict=True))
    return seconds, cpu_seconds, quality(result)


REQUESTS: dict[str, Callable[..., Any]] = {
    "golden cases": lambda: list(record.CASES),
    "digests": record.compute,
    "timed cases": lambda: dict.fromkeys(DATA_CASES, True) | dict.fromkeys(SPLATS, False),
    "time": time_case,
}


def main() -> None:
    """Answer until the input ends."""
    answers, sys.stdout = sys.stdout, sys.stderr  # what a case prints is no answer
    for line in sys.stdin:
        request, *arguments = json.loads(line)
        print(json.dumps(REQUESTS[request](*arguments)), file=answers, flush=True)


if __name__ == "__main__":
    main()
