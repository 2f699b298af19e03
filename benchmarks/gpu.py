"""How fast and how exactly does a GPU render?"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch

from kcgs import Scene

from .core.clocks import milliseconds, threads
from .core.cuda import capture, check_device, count_kernels, finish, megabytes
from .core.figures import Panel, save_lines
from .core.goals import Goal, goals_table, missed_goals
from .core.run import Job, Options, Page, Row
from .core.scenes import BATCH, BATCHES, FITTED, fits_in, scene_of
from .core.tables import join_sections, means_table, values_of
from .render import ANISOTROPIES, CUTOFFS, DEFAULT_CUTOFF, differentiate, differentiate_exactly, errors, needles, render

# device of each kernel
METHODS = {"cuda": "cuda", "tiled": "cuda", "cpu": "cpu"}
# slower kernels that also render a scene
COMPARED = {
    "W3": ("tiled", "cpu"),
    "W1": ("tiled", "cpu"),
    "W2": ("cpu",),
    "W4": ("cpu",),
    **dict.fromkeys(BATCHES, ("cpu",)),
}
# standard deviations in pixels, of Gaussians three times as long as wide
GIANTS = (1e2, 1e4)
ROUNDS = 20
# calls per timing, without a pause between them
CALLS = 10
SLOW_ROUNDS = 5
# scenes of 480 x 854 pixels
SCENES_480P = ("W1", "W2", "dog-1250", "dog-7500")
# largest times on an H100 or H200, in milliseconds
_GOALS_480P = {"forward_ms": 0.50, "both_ms": 0.75, "captured_forward_ms": 0.12, "captured_both_ms": 0.22}
GOALS = {
    **dict.fromkeys(SCENES_480P, _GOALS_480P),
    "W4": {"forward_ms": 1.3, "both_ms": 2.4, "peak_MB": 200.0},
    BATCH: {"forward_ms": 0.6, "both_ms": 1.0},
}
EAGER = ("forward_ms", "both_ms")
TIMES = (
    *EAGER, "captured_forward_ms", "captured_both_ms", "captured_difference",
    "kernels", "copies", "kernels_ms", "peak_MB",
)  # fmt: skip
METHOD = f"""Forward is one image, both one image and its gradients, through `region_splat` and autograd, in
milliseconds: medians of {ROUNDS} times {CALLS} calls of `cuda` in a row, the GPU waited for after the last, and
of {SLOW_ROUNDS} single calls of the others. Captured is the replay of the same call as a CUDA graph, with inputs in
place. `cuda` and `tiled` run on the GPU, `cpu` on all cores of the same machine. Kernels, copies (fills among them) and
the sum of their own times are of one image and its gradients, by torch's profiler; MB is what these add at the peak of
the GPU's memory. Scenes and needles are those of the report of render; giants are as many Gaussians that wide at least,
and three times as long. W1, W2, W3 and W4 have hard contours or, by their name, soft ones. `batch` has 64 images of
128 x 128 with 256 Gaussians each, and a map each or none. dog-1250 and dog-7500 are fits by `best` of the first frame
of DAVIS dog with its mask, kodim05-10000 one without regions, in DATA/scenes. Errors are the largest, against the
dense reference in float64 at cutoff 0: of the image / of gradients, relative to the largest of their tensor."""
# further line for reports that have BATCHES
METHOD_OF_BATCHES = "batch-B-S has B images of S x S pixels, with a map each and a Gaussian for every 64 pixels."


def make_scene(image: str, data: str) -> Scene:
    """Make the scene "needles ANISOTROPY", "giants SIGMA", or a scene of `scene_of`."""
    kind, _, number = image.partition(" ")
    if kind == "needles":
        return needles(float(number))
    return needles(3.0, float(number)) if kind == "giants" else scene_of(image, data)


def measure_errors(scene: Scene, method: str, cutoffs: list[float]) -> list[Row]:
    """Compare a kernel with the reference at each cutoff."""
    truth = differentiate_exactly(scene)
    return [{"cutoff": cutoff, **errors(truth, scene, method, cutoff)} for cutoff in cutoffs]


def measure_times(scene: Scene, method: str, rounds: int, calls: int) -> list[Row]:
    """Time eager calls, and measure the memory that one call adds."""
    forward = partial(torch.no_grad()(render), scene, method, DEFAULT_CUTOFF)
    both = partial(differentiate, scene, method, DEFAULT_CUTOFF)
    with threads(os.cpu_count() or 1):
        row = _milliseconds({"forward_ms": forward, "both_ms": both}, rounds, calls)
    return [row | ({"peak_MB": megabytes(both)} if scene.field.means.is_cuda else {})]


def measure_captured(scene: Scene, method: str, rounds: int, calls: int) -> list[Row]:
    """Time replays of CUDA graphs, and compare the result of the last replay with an eager call."""
    both = partial(differentiate, scene, method, DEFAULT_CUTOFF)
    forward_graph, _ = capture(partial(torch.no_grad()(render), scene, method, DEFAULT_CUTOFF))
    both_graph, (image, gradients) = capture(both)
    replays = {"captured_forward_ms": forward_graph.replay, "captured_both_ms": both_graph.replay}
    row = _milliseconds(replays, rounds, calls)
    eager_image, eager_gradients = both()
    pairs = zip([image, *gradients], [eager_image, *eager_gradients], strict=True)
    row["captured_difference"] = max(float((a - b).abs().nan_to_num(torch.inf).max()) for a, b in pairs)
    return [row]


def measure_kernels(scene: Scene, method: str, calls: int) -> list[Row]:
    """Count the GPU kernels that one image and its gradients launch."""
    return [count_kernels(partial(differentiate, scene, method, DEFAULT_CUTOFF), calls)]


TASKS: dict[str, Callable[..., list[Row]]] = {
    "errors": measure_errors, "times": measure_times, "captured": measure_captured, "kernels": measure_kernels
}  # fmt: skip


def measure(image: str, method: str, device: str, task: str, settings: dict[str, Any], data: str) -> list[Row]:
    """Run one of TASKS on a scene with one kernel."""
    check_device(device)
    scene = make_scene(image, data).to(device)
    row = {"image": image, "method": method, "n": scene.field.means.numel() // 2, "cutoff": DEFAULT_CUTOFF}
    return [row | result for result in TASKS[task](scene, method, **settings)]


def jobs(options: Options) -> list[Job]:
    """List errors, then times; captures and the profiler's counts come last, since they may disturb times."""
    fits = [] if options.quick else [f"{name} soft" for name in fits_in(options.data)]
    timed = ["W3"] if options.quick else ["W3", "W1", "W1 soft", "W2", *fits, "W4", f"{BATCH} none", BATCH]
    batches = [] if options.quick else BATCHES
    swept = ["W3"] if options.quick else ["W3", "W1", "W1 soft", *(f"{name} soft" for name in FITTED), *fits[:1]]
    stiff = [*(f"needles {a:g}" for a in ANISOTROPIES), *(f"giants {sigma:g}" for sigma in GIANTS)]
    speed = {"rounds": 1 if options.quick else ROUNDS, "calls": CALLS}
    slow = {"rounds": 1 if options.quick else SLOW_ROUNDS, "calls": 1}
    plan: list[tuple[str, str, str, dict[str, Any]]] = [
        *((image, "cuda", "errors", {"cutoffs": CUTOFFS}) for image in swept),
        *((image, "cuda", "errors", {"cutoffs": (0.0,)}) for image in stiff),
        *((image, "cuda", "times", speed) for image in timed),
        *((image, "cuda", "times", speed) for image in batches),
        *((image, method, "times", slow) for image in (*timed, *batches) for method in COMPARED.get(image, ())),
        *((image, "cuda", "captured", speed) for image in timed),
        *((image, "cuda", "kernels", {"calls": CALLS}) for image in timed),
    ]
    data = str(options.data or "")
    return [
        {"image": i, "method": m, "device": METHODS[m], "task": task, "settings": settings, "data": data}
        for i, m, task, settings in plan
    ]


def _milliseconds(actions: Mapping[str, Callable[[], object]], rounds: int, calls: int) -> Row:
    """Return the milliseconds of one call of each action, from timings of `calls` calls in a row."""
    times = milliseconds({name: partial(finish, action, calls) for name, action in actions.items()}, rounds)
    return {name: time / calls for name, time in times.items()}


def page(folder: Path, rows: list[Row]) -> Page:
    """Write the report."""
    swept = [row for row in rows if "image_error" in row]
    timed = [row for row in rows if row.keys() & {*TIMES} and row["cutoff"] == DEFAULT_CUTOFF]
    captured = [
        {"method": "cuda, captured", "n": row["n"], **{name: row[f"captured_{name}"] for name in EAGER}}
        for row in timed
        if "captured_both_ms" in row
    ]
    panels = [Panel("", [*timed, *captured], "n", name, ("log", "log")) for name in EAGER]
    save_lines(folder / "gpu.png", panels, "method", "n")
    ours = [row for row in timed if row["method"] == "cuda"]
    goals = [
        Goal(row["image"], name, limit, row[name])
        for row in ours
        for name, limit in GOALS.get(_scene_name(row), {}).items()
        if name in row
    ]
    tables = join_sections(
        means_table(timed, ["image", "method"], "", TIMES),
        "Errors of the image / of gradients:",
        means_table(swept, ["image", "method"], "cutoff", ("image_error", "gradient_error")),
        goals_table(goals),
    )
    sentences = [
        *_speed([row for row in ours if _scene_name(row) in SCENES_480P]),
        *_ratios(timed),
        *_exactness([row for row in swept if row["method"] == "cuda"]),
    ]
    method = f"{METHOD}\n{METHOD_OF_BATCHES}" if any(row["image"] in BATCHES for row in rows) else METHOD
    return Page(" ".join(sentences), "gpu.png", tables, missed_goals(goals), method)


def _speed(rows: list[Row]) -> Iterator[str]:
    """Yield the times at 480 x 854, eager and captured."""
    texts = {name: _span(values) for name in TIMES if (values := values_of(rows, name))}
    if "both_ms" in texts:
        yield f"`cuda` renders 480 x 854 pixels in {texts['forward_ms']} ms, with gradients in {texts['both_ms']} ms."
    if "captured_both_ms" in texts:
        yield f"A CUDA graph takes {texts['captured_forward_ms']} and {texts['captured_both_ms']} ms."


def _ratios(rows: list[Row]) -> Iterator[str]:
    """Yield how much longer other kernels take."""
    times = {(row["image"], row["method"]): row["both_ms"] for row in rows if "both_ms" in row}
    for other, place in {"tiled": "on the same GPU", "cpu": "on all cores beside it"}.items():
        images = [image for image, method in times if method == other and (image, "cuda") in times]
        ratios = [times[image, other] / times[image, "cuda"] for image in images]
        if ratios:
            yield f"With gradients `{other}` {place} takes {_span(ratios)} times as long."


def _exactness(rows: list[Row]) -> Iterator[str]:
    """Yield the largest errors of the image."""
    default, stiff = (
        values_of([row for row in rows if row["cutoff"] == cutoff], "image_error") for cutoff in (DEFAULT_CUTOFF, 0.0)
    )
    if default:
        yield f"The largest error of its image is {max(default):.1g} at the default cutoff."
    if stiff:
        yield f"Of needles and giants, without a cutoff, it is {max(stiff):.1g}."


def _scene_name(row: Row) -> str:
    return str(row["image"]).partition(" ")[0]


def _span(values: list[float]) -> str:
    return " to ".join(dict.fromkeys(f"{value:.2g}" for value in (min(values), max(values))))
