"""How fast and how exactly does a GPU render?"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch

from .core.clocks import milliseconds
from .core.compare import group_by, means_table, values_of
from .core.figures import Panel, save_lines
from .core.run import Job, Options, Page, Row
from .core.scenes import FITTED, scene_of
from .render import ANISOTROPIES, CUTOFFS, DEFAULT_CUTOFF, LARGEST_REFERENCE, differentiate, errors, needles, render

# kernel and device
METHODS = {"cuda": "cuda", "tiled": "cuda", "cpu": "cpu"}
ROUNDS = 20
METHOD = """Forward is one image, both one image and its gradients, through `region_splat` and autograd, in
milliseconds: medians of 20, all kernels and cutoffs of a scene in turns, the GPU waited for. `cuda` and `tiled` run on
the GPU, `cpu` on all cores of the same machine. Scenes, errors and needles are those of the report of render. MB is
what one image and its gradients add at the peak of the GPU's memory."""


def finish(action: Callable[[], object]) -> None:
    """Wait for the GPU, too."""
    action()
    torch.cuda.synchronize()


def megabytes(action: Callable[[], object]) -> float:
    """Measure what an action adds at the peak of the GPU's memory."""
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    finish(action)
    return (torch.cuda.max_memory_allocated() - before) / 2**20


def measure(image: str, cutoffs: list[float], rounds: int) -> list[Row]:
    """Time the kernels of a scene, in turns, and take their errors and memory."""
    if not torch.cuda.is_available():
        raise ValueError("benchmark gpu needs a CUDA device; torch finds none")
    if image.startswith("needles"):
        scene, names = needles(float(image.split()[1])).to("cuda"), ("cuda", "tiled")
        return [{"image": image, "method": name, "cutoff": 0.0, **errors(scene, name, 0.0)} for name in names]
    scenes = {name: scene_of(image).to(device) for name, device in METHODS.items()}
    has_reference = math.prod(scenes["cpu"].size) * scenes["cpu"].field.num_gaussians < LARGEST_REFERENCE
    keys = [(name, cutoff) for name in METHODS for cutoff in cutoffs]
    with torch.no_grad():
        forward = milliseconds({k: partial(finish, partial(render, scenes[k[0]], *k)) for k in keys}, rounds)
    both = milliseconds({k: partial(finish, partial(differentiate, scenes[k[0]], *k)) for k in keys}, rounds)
    rows = []
    for name, cutoff in keys:
        row = {"image": image, "method": name, "cutoff": cutoff}
        row |= {"forward_ms": forward[name, cutoff], "both_ms": both[name, cutoff]}
        if METHODS[name] == "cuda":
            row |= errors(scenes[name], name, cutoff) if has_reference else {}
            row["peak_MB"] = megabytes(partial(differentiate, scenes[name], name, cutoff))
        rows.append(row)
    return rows


def jobs(options: Options) -> list[Job]:
    """Time workloads and fitted scenes, and look at needles."""
    images = ["W3"] if options.quick else ["W3", "W1", *FITTED, "W2", "W4"]
    cutoffs = {image: CUTOFFS if image in ("W3", "W1", *FITTED) else (DEFAULT_CUTOFF,) for image in images}
    cutoffs |= {f"needles {a:g}": (0.0,) for a in ANISOTROPIES}
    return [{"image": i, "cutoffs": c, "rounds": 1 if options.quick else ROUNDS} for i, c in cutoffs.items()]


def page(folder: Path, rows: list[Row]) -> Page:
    """Write the report."""
    timed = [row for row in rows if "both_ms" in row]
    default = [row for row in timed if abs(row["cutoff"] / DEFAULT_CUTOFF - 1) < 0.01]
    swept = [row for row in timed if "image_error" in row]
    panels = [
        Panel(str(image), group, "both_ms", "image_error", ("log", "log"))
        for (image,), group in group_by(swept, ["image"]).items()
    ]
    save_lines(folder / "gpu.png", panels, "method", "cutoff")
    times = {(row["image"], row["method"]): row["both_ms"] for row in default}
    to_tiled, to_cpu = (
        {image: times[image, other] / times[image, "cuda"] for image, name in times if name == "cuda"}
        for other in ("tiled", "cpu")
    )
    stiff = [row for row in rows if "both_ms" not in row]
    tiled, cpu = (f"{min(r.values()):.1f} to {max(r.values()):.1f} times" for r in (to_tiled, to_cpu))
    error, stiff_error = (
        max(values_of([row for row in part if row["method"] == "cuda"], "image_error"), default=math.nan)
        for part in (default, stiff)
    )
    answer = (
        f"Forward and backward, `cuda` is {tiled} as fast as `tiled` on the same GPU, and {cpu} as fast as `cpu` on "
        f"all cores beside it. Its largest error is {error:.1g} at the default cutoff, and {stiff_error:.1g} without a "
        "cutoff, even of Gaussians a million times longer than wide."
    )
    columns = ("forward_ms", "both_ms", "image_error", "gradient_error", "peak_MB")
    table = means_table([*default, *stiff], ["image", "method"], "", columns)
    slow = [f"{image}: {ratio:.2f}" for image, ratio in to_cpu.items() if ratio < 1]
    losses = f"The GPU is slower than the CPU, times as fast: {', '.join(slow)}." if slow else ""
    return Page("How fast and how exactly does a GPU render?", answer, "gpu.png", table, losses, METHOD)
