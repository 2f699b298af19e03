"""How fast and how exactly does each backend render?"""

from __future__ import annotations

import copy
import functools
import math
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from kcgs import GaussianField, Scene
from kcgs.functional import region_splat, scale_rotation_to_cholesky

from .core.clocks import milliseconds, peak_megabytes, threads
from .core.figures import Panel, save_lines
from .core.run import Job, Options, Page, Row
from .core.scenes import FITTED, scene_of
from .core.tables import group_by, means_table, values_of

CUTOFFS = (1 / 255, 1e-3, 1e-4, 1e-6)
DEFAULT_CUTOFF = 1e-4
# those of a CPU; the experiment `gpu` times the others
BACKENDS = ("cpu", "tiled")
ROUNDS = 9
# numbers of cores to time, as far as the machine has them
CORES = (1, 2, 4, 8, 16)
# most pairs of a Gaussian and a pixel: the dense reference holds all pairs in memory
LARGEST_REFERENCE = 2_000_000_000
ANISOTROPIES = (1.0, 1e2, 1e4, 1e6)
NEEDLES_SIZE = (96, 128)
METHOD = """Forward is one image, both one image and its gradients, through `region_splat` and autograd, in
milliseconds on one core: medians, all backends, cutoffs and numbers of cores of a scene in turns. The columns of
cores say how many times as fast as on one core forward and backward are. W3, W1, W2 and W4
are sums of 12 Gaussians of about one size with 6 regions (200 x 300 with 20 Gaussians, 480 x 854 with 1,250 and
7,500, 2160 x 3840 with 50,000); the others are fitted scenes of the zoo. Errors are the largest, against the dense
reference in float64 at cutoff 0: of the image, and of gradients relative to the largest of their tensor. MB is what
one image and its gradients add at the peak, in a process of its own. Needles are 37 Gaussians, turned from 0 to 180
degrees, 0.5 pixels thin, at cutoff 0."""


def render(scene: Scene, backend: str, cutoff: float) -> Tensor:
    """Render a scene's own size by a named backend."""
    f = scene.field
    return region_splat(
        f.means, f.cholesky, f.colors, f.region_ids, scene.regions, size=scene.size, cutoff=cutoff, backend=backend
    )


@functools.cache
def smooth_gradient(shape: torch.Size, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Make a gradient with values of both signs; it is cached, because making it takes as long as a render."""
    return torch.cos(torch.linspace(-40, 40, shape.numel(), dtype=dtype, device=device)).view(shape)


def differentiate(scene: Scene, backend: str, cutoff: float) -> tuple[Tensor, list[Tensor]]:
    """Return the image, and the gradients of means, cholesky and colors for the image gradient `smooth_gradient`."""
    scene.zero_grad(set_to_none=True)
    image = render(scene, backend, cutoff)
    image.backward(smooth_gradient(image.shape, image.dtype, image.device))
    field = scene.field
    return image.detach(), [p.grad for p in (field.means, field.cholesky, field.colors) if p.grad is not None]


def render_by_name(name: str, backend: str) -> None:
    """Render and differentiate a scene in a process whose memory is measured."""
    differentiate(scene_of(name), backend, DEFAULT_CUTOFF)


def needles(anisotropy: float, width: float = 0.5) -> Scene:
    """Make Gaussians of one shape, turned from 0 to pi; `width` is their lesser standard deviation in pixels."""
    angle = torch.linspace(0, math.pi, 37, dtype=torch.float64)
    scales = torch.tensor([width * anisotropy, width], dtype=torch.float64).expand(37, 2)
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(37, 2, generator=generator) * torch.tensor([NEEDLES_SIZE[1], NEEDLES_SIZE[0]])
    cholesky = scale_rotation_to_cholesky(scales, angle).float()
    return Scene(GaussianField(means, cholesky, torch.ones(37, 1), size=NEEDLES_SIZE))


def differentiate_exactly(scene: Scene) -> tuple[Tensor, list[Tensor]]:
    """Return the image and the gradients of the dense reference in float64, without a cutoff."""
    return differentiate(copy.deepcopy(scene).double(), "reference", 0.0)


def errors(truth: tuple[Tensor, list[Tensor]], scene: Scene, backend: str, cutoff: float) -> dict[str, float]:
    """Return the largest errors of a backend against `differentiate_exactly`."""
    exact, exact_gradients = truth
    image, gradients = differentiate(scene, backend, cutoff)
    pairs = zip(gradients, exact_gradients, strict=True)
    worst = max(float((g - e).abs().max() / e.abs().max().clamp_min(1e-12)) for g, e in pairs)
    return {"image_error": float((image - exact).abs().max()), "gradient_error": worst}


def on_threads(count: int, action: Callable[[], object]) -> None:
    """Run an action on `count` threads."""
    with threads(count):
        action()


def cores() -> list[int]:
    """Return the numbers of cores that this process can use."""
    most = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return [count for count in CORES if count <= most]


def measure(image: str, cutoffs: list[float], rounds: int) -> list[Row]:
    """Time a scene on one thread and on more, in turns; on one thread also measure errors and memory."""
    if image.startswith("needles"):
        scene = needles(float(image.split()[1]))
        truth, row = differentiate_exactly(scene), {"image": image, "threads": 1, "cutoff": 0.0}
        return [{**row, "method": name, **errors(truth, scene, name, 0.0)} for name in BACKENDS]
    scene = scene_of(image)
    has_reference = math.prod(scene.size) * scene.field.num_gaussians < LARGEST_REFERENCE
    exact = differentiate_exactly(scene) if has_reference else None
    keys = [(backend, cutoff, count) for backend in BACKENDS for cutoff in cutoffs for count in cores()]
    with torch.no_grad():
        forward = milliseconds({k: partial(on_threads, k[2], partial(render, scene, *k[:2])) for k in keys}, rounds)
    both = milliseconds({k: partial(on_threads, k[2], partial(differentiate, scene, *k[:2])) for k in keys}, rounds)
    rows = []
    for backend, cutoff, count in keys:
        row = {"image": image, "method": backend, "threads": count, "cutoff": cutoff}
        row |= {"forward_ms": forward[backend, cutoff, count], "both_ms": both[backend, cutoff, count]}
        row |= errors(exact, scene, backend, cutoff) if count == 1 and exact else {}
        if count == 1 and cutoff == DEFAULT_CUTOFF and rounds > 1:
            row["peak_MB"] = peak_megabytes(render_by_name, image, backend, warm_up=("W3", backend))
        rows.append(row)
    return rows


def jobs(options: Options) -> list[Job]:
    """List timings of workloads and fitted scenes, and errors of needles."""
    swept = ["W3"] if options.quick else ["W3", "W1", *FITTED]
    images = [*swept, *([] if options.quick else ["W2", "W4"])]
    listing = [{"image": image, "cutoffs": CUTOFFS if image in swept else (DEFAULT_CUTOFF,)} for image in images]
    listing += [{"image": f"needles {a:g}", "cutoffs": (0.0,)} for a in ANISOTROPIES]
    rounds = 1 if options.quick else ROUNDS
    return [{**job, "rounds": rounds} for job in listing]


def page(folder: Path, rows: list[Row]) -> Page:
    """Write the report."""
    timed = [row for row in rows if "both_ms" in row]
    default = [row for row in timed if row["cutoff"] == DEFAULT_CUTOFF]
    swept = [row for row in timed if "image_error" in row]
    groups, scales = group_by(swept, ["image"]), ("log", "log")
    panels = [Panel(str(image), group, "both_ms", "image_error", scales) for (image,), group in groups.items()]
    save_lines(folder / "render.png", panels, "method", "cutoff")
    times = {(row["image"], row["method"], row["threads"]): row["both_ms"] for row in default}
    images = list(dict.fromkeys(row["image"] for row in default))
    counts = sorted({row["threads"] for row in default} - {1})
    for row in default:
        one = times[row["image"], row["method"], 1]
        row |= {f"on {n} cores": one / times[row["image"], row["method"], n] for n in counts}
    ratios = [times[image, "tiled", 1] / times[image, "cpu", 1] for image in images]
    faster = {n: [times[image, "cpu", 1] / times[image, "cpu", n] for image in images] for n in counts}
    stiff = [row for row in rows if "both_ms" not in row and row["method"] == "cpu"]
    error, stiff_error = (max(values_of(part, "image_error"), default=math.nan) for part in (default, stiff))
    on_cores = "".join(f", and {_span(values)} as fast on {n} cores as on one" for n, values in faster.items())
    answer = (
        f"Forward and backward, `cpu` is {_span(ratios)} as fast as `tiled` on one core{on_cores}. Its largest error "
        f"is {error:.1g} at the default cutoff, and {stiff_error:.1g} without a cutoff, even of Gaussians a million "
        "times longer than wide."
    )
    columns = ("forward_ms", "both_ms", *(f"on {n} cores" for n in counts), "image_error", "gradient_error", "peak_MB")
    one_thread = [row for row in default if row["threads"] == 1]
    table = means_table([*one_thread, *stiff], ["image", "method"], "", columns)
    slow = [
        f"{image} on {n}: {ratio:.2f}"
        for n, values in faster.items()
        for image, ratio in zip(images, values, strict=True)
        if ratio < 1
    ]
    losses = f"More cores are slower than one, times as fast: {', '.join(slow)}." if slow else ""
    return Page(answer, "render.png", table, losses, METHOD)


def _span(ratios: list[float]) -> str:
    return f"{min(ratios):.1f} to {max(ratios):.1f} times"
