"""How fast and how exactly does each backend render?"""

from __future__ import annotations

import copy
import functools
import math
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from kcgs import GaussianField, Scene
from kcgs.functional import region_splat, scale_rotation_to_cholesky

from .core.clocks import milliseconds, peak_megabytes, threads
from .core.compare import format_value, group_by, means_table
from .core.figures import Panel, save_lines
from .core.run import Job, Options, Page, Row
from .core.scenes import FITTED, scene_of

CUTOFFS = (1 / 255, 1e-3, 1e-4, 1e-6)
DEFAULT_CUTOFF = 1e-4
ROUNDS = 5
# the dense reference needs memory for all pairs of Gaussians and pixels
LARGEST_REFERENCE = 2_000_000_000
ANISOTROPIES = (1.0, 1e2, 1e4, 1e6)
NEEDLES_SIZE = (96, 128)
METHOD = """Forward is one image, both one image and its gradients, through `region_splat` and autograd, in
milliseconds: medians, all backends and cutoffs of a scene in turns. W3, W1, W2 and W4 are sums of 12 Gaussians of
about one size with 6 regions (200 x 300 with 20 Gaussians, 480 x 854 with 1,250 and 7,500, 2160 x 3840 with 50,000);
the others are fitted scenes of the zoo. Errors are the largest, against the dense reference in float64 at cutoff 0: of
the image, and of gradients relative to the largest of their tensor. MB is what one image and its gradients add at the
peak, in a process of its own. Needles are 37 Gaussians, turned from 0 to 180 degrees, 0.5 pixels thin, at cutoff 0."""


def render(scene: Scene, backend: str, cutoff: float) -> Tensor:
    """Render a scene's own size by a named backend."""
    f = scene.field
    return region_splat(
        f.means, f.cholesky, f.colors, f.region_ids, scene.regions, size=scene.size, cutoff=cutoff, backend=backend
    )


@functools.cache
def smooth_gradient(shape: torch.Size, dtype: torch.dtype) -> Tensor:
    """Make a gradient of both signs, once, since that takes as long as a render."""
    return torch.cos(torch.linspace(-40, 40, shape.numel(), dtype=dtype)).view(shape)


def differentiate(scene: Scene, backend: str, cutoff: float) -> tuple[Tensor, list[Tensor]]:
    """Return the image, and the gradients of means, cholesky and colors under a smooth gradient of both signs."""
    scene.zero_grad(set_to_none=True)
    image = render(scene, backend, cutoff)
    image.backward(smooth_gradient(image.shape, image.dtype))
    field = scene.field
    return image.detach(), [p.grad for p in (field.means, field.cholesky, field.colors) if p.grad is not None]


def render_by_name(name: str, backend: str) -> None:
    """Render and differentiate a scene, for a clock of memory."""
    differentiate(scene_of(name), backend, DEFAULT_CUTOFF)


def needles(anisotropy: float) -> Scene:
    """Make Gaussians of one shape, turned from 0 to pi."""
    angle = torch.linspace(0, math.pi, 37, dtype=torch.float64)
    scales = torch.tensor([0.5 * anisotropy, 0.5], dtype=torch.float64).expand(37, 2)
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(37, 2, generator=generator) * torch.tensor([NEEDLES_SIZE[1], NEEDLES_SIZE[0]])
    cholesky = scale_rotation_to_cholesky(scales, angle).float()
    return Scene(GaussianField(means, cholesky, torch.ones(37, 1), size=NEEDLES_SIZE))


def errors(scene: Scene, backend: str, cutoff: float) -> dict[str, float]:
    """Return the largest errors."""
    exact, exact_gradients = differentiate(copy.deepcopy(scene).double(), "reference", 0.0)
    image, gradients = differentiate(scene, backend, cutoff)
    pairs = zip(gradients, exact_gradients, strict=True)
    worst = max(float((g - e).abs().max() / e.abs().max().clamp_min(1e-12)) for g, e in pairs)
    return {"image_error": float((image - exact).abs().max()), "gradient_error": worst}


def measure(image: str, count: int, cutoffs: list[float], rounds: int) -> list[Row]:
    """Time a scene on so many threads; on one, take errors and memory, too."""
    if image.startswith("needles"):
        scene = needles(float(image.split()[1]))
        return [{"image": image, "method": b, "threads": 1, "cutoff": 0.0, **errors(scene, b, 0.0)} for b in backends()]
    scene = scene_of(image)
    has_reference = math.prod(scene.size) * scene.field.num_gaussians < LARGEST_REFERENCE
    keys = [(backend, cutoff) for backend in backends() for cutoff in cutoffs]
    with threads(count), torch.no_grad():
        forward = milliseconds({key: partial(render, scene, *key) for key in keys}, rounds)
    with threads(count):
        forward_and_backward = milliseconds({key: partial(differentiate, scene, *key) for key in keys}, rounds)
    rows = []
    for backend, cutoff in keys:
        row = {"image": image, "method": backend, "threads": count, "cutoff": cutoff}
        row |= {"forward_ms": forward[backend, cutoff], "both_ms": forward_and_backward[backend, cutoff]}
        row |= errors(scene, backend, cutoff) if count == 1 and has_reference else {}
        if count == 1 and cutoff == DEFAULT_CUTOFF and rounds > 1:
            row["peak_MB"] = peak_megabytes(render_by_name, image, backend, warm_up=("W3", backend))
        rows.append(row)
    return rows


def backends() -> list[str]:
    """Name the backends that run on this machine."""
    return ["cpu", "tiled", *(["cuda"] if torch.cuda.is_available() else [])]


def jobs(options: Options) -> list[Job]:
    """Time workloads and fitted scenes, and look at needles."""
    swept = ["W3"] if options.quick else ["W3", "W1", *FITTED]
    images = [*swept, *([] if options.quick else ["W2", "W4"])]
    listing = [
        {"image": image, "count": count, "cutoffs": CUTOFFS if image in swept else (DEFAULT_CUTOFF,)}
        for image in images
        for count in (1, 2)
    ]
    listing += [{"image": f"needles {a:g}", "count": 1, "cutoffs": (0.0,)} for a in ANISOTROPIES]
    rounds = 1 if options.quick else ROUNDS
    return [{**job, "rounds": rounds} for job in listing]


def cores_table(speedups: dict[str, float]) -> str:
    """Tabulate what more cores would give, if the share of a step that two threads do not divide stayed as it is."""
    lines = ["| image | 2 cores | share not divided | 8 cores, by Amdahl | 16 cores |", "|---|---|---|---|---|"]
    for image, speedup in speedups.items():
        share = min(max(2 / speedup - 1, 0.0), 1.0)
        predicted = [1 / (share + (1 - share) / cores) for cores in (8, 16)]
        lines.append(f"| {image} | {speedup:.2f} | {share:.2f} | {predicted[0]:.1f} | {predicted[1]:.1f} |")
    return "\n".join(lines)


def page(folder: Path, rows: list[Row]) -> Page:
    """Write the report."""
    timed = [row for row in rows if "both_ms" in row]
    default = [row for row in timed if abs(row["cutoff"] / DEFAULT_CUTOFF - 1) < 0.01]
    swept = [row for row in timed if "image_error" in row]
    groups, scales = group_by(swept, ["image"]), ("log", "log")
    panels = [Panel(str(image), group, "both_ms", "image_error", scales) for (image,), group in groups.items()]
    save_lines(folder / "render.png", panels, "method", "cutoff")
    columns = ("forward_ms", "both_ms", "image_error", "gradient_error", "peak_MB")
    tables = [means_table(default, ["image", "method", "threads"], columns)]
    tables.append(means_table(swept, ["image", "method", "cutoff"], columns[:4]))
    tables.append(means_table([row for row in rows if "both_ms" not in row], ["image", "method"], columns[2:4]))
    times = {(row["image"], row["method"], row["threads"]): row["both_ms"] for row in default}
    ratios = {
        image: times[image, "tiled", 1] / times[image, "cpu", 1] for image, method, _ in times if method == "tiled"
    }
    cores = {image: times[image, "cpu", 1] / times[image, "cpu", 2] for image in ratios if (image, "cpu", 2) in times}
    text = "`cpu` is {} times as fast as `tiled` on one thread; two threads are {} times as fast as one."
    text = text.format(
        *(", ".join(f"{format_value('', r)} ({image})" for image, r in values.items()) for values in (ratios, cores))
    )
    tables.append(cores_table(cores))
    slow = [f"{image}: {ratio:.2f}" for image, ratio in cores.items() if ratio < 1]
    losses = f"Two threads are slower than one, times as fast: {', '.join(slow)}." if slow else ""
    return Page("How fast and how exactly does each backend render?", METHOD, text, "render.png", tables, losses)
