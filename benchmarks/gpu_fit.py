"""How fast does a GPU fit, and how well?"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from statistics import fmean
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import torch
from torch import Tensor

from kcgs import FitConfig, fit
from kcgs.functional import ef_psnr, psnr
from kcgs.rate import fit_bytes

from .core.clocks import threads
from .core.compare import Comparison, differences, losses_table
from .core.cuda import check_device, finish, synchronize
from .core.figures import Panel, save_lines
from .core.fits import QUICK_ITERATIONS
from .core.goals import Goal, goals_table, missed_goals
from .core.images import FRAMES, choose, load
from .core.run import Job, Options, Page, Row
from .core.tables import group_by, join_sections, means_table, values_of

Result = TypeVar("Result")

GPU, CORES, OTHER = "best, GPU", "best, cores", "gaussian-image, GPU"
FILE_GPU, FILE_CORES = "file, GPU", "file, cores"
FIRST = {"process": "best, GPU, new process", "machine": "best, GPU, new machine"}
# recipe, settings that differ from the recipe, device
METHODS: dict[str, tuple[str, dict[str, Any], str]] = {
    GPU: ("best", {}, "cuda"),
    CORES: ("best", {}, "cpu"),
    OTHER: ("gaussian-image", {"iterations": 5_000}, "cuda"),
    FILE_GPU: ("best", {"objective": "l2"}, "cuda"),
    FILE_CORES: ("best", {"objective": "l2"}, "cpu"),
    **dict.fromkeys(FIRST.values(), ("best", {}, "cuda")),
}
KODAK_COUNT = 10_000
# 0.15 bits per pixel
FILE_BYTES = 7_372
QUICK_FILE_BYTES = 400
DAVIS_COUNTS = (500, 1_250, 5_000, 7_500, 10_000)
# images and N at which the other methods are compared with `best` on a GPU
KODAK_COMPARED = ("kodim05", "kodim15", "kodim23")
DAVIS_COMPARED = [("dog", 1_250), ("dog", 7_500)]
# iterations of the fit that compiles all programs: events act at fractions of a fit, so that a short fit is enough
WARM_UP_ITERATIONS = 60
# on an H100 or H200: largest seconds of a fit, least PSNR in dB
GOALS = {"Kodak": {"seconds": 0.5, "psnr": 36.5}, "DAVIS": {"seconds": 1.5}}
# seconds that the first fit of a process may take longer than the next
GOAL_OF_A_FIRST_FIT = 15.0
CACHES = ("NUMBA_CACHE_DIR", "TRITON_CACHE_DIR")
COMPARISONS = (Comparison(GPU, CORES), Comparison(GPU, OTHER), Comparison(FILE_GPU, FILE_CORES))
QUANTITIES = ("images", "seconds", "next_seconds", "process_seconds", "iterations", "psnr", "ef_psnr")
METHOD = """Photos of Kodak without regions, and first frames of DAVIS with the given masks. Seconds are those of the
call of `fit`, image and mask on the device, the GPU waited for; a short fit of the same size comes before, and is not
in them. *GPU* is a GPU, *cores* all cores beside it."""
# further lines for reports that have the method
NOTES = {
    OTHER: f"`gaussian-image` has {METHODS[OTHER][1]['iterations']:,} iterations, a tenth of its own.",
    FIRST["process"]: """*new process* is the first fit of a process, and *next* the second fit of that process;
*process seconds* begin before Python starts.""",
    FIRST["machine"]: "*new machine* is the first fit of a process with empty caches of compiled code.",
    FILE_GPU: f"""*file* is `fit_bytes` without a mask, in {FILE_BYTES:,} bytes for PSNR; its PSNR is that of the
decoded scene.""",
}


def set_of(image: str) -> str:
    """Return the name of an image's set."""
    return "Kodak" if image.startswith("kodim") else "DAVIS" if image in FRAMES else "others"


def config_of(method: str, quick: bool) -> FitConfig:
    """Return the settings of a method."""
    recipe, settings, _ = METHODS[method]
    return FitConfig.from_recipe(recipe, **{**settings, **({"iterations": QUICK_ITERATIONS} if quick else {})})


def shorten(config: FitConfig) -> FitConfig:
    """Return the settings of a fit that compiles all programs."""
    return config.model_copy(update={"iterations": min(WARM_UP_ITERATIONS, config.planned_iterations)})


@cache
def warm_up(config: FitConfig, n: int, size: tuple[int, int], has_labels: bool, device: str) -> None:
    """Fit noise of this size, so that everything is compiled."""
    noise = torch.rand(3, *size, generator=torch.Generator().manual_seed(0)).to(device)
    labels = (noise[0].cumsum(1) > size[1] / 4).long() if has_labels else None
    finish(lambda: fit(noise, labels, n, recipe=shorten(config)))


def timed(action: Callable[[], Result]) -> tuple[Result, float]:
    """Return the result of an action and its seconds."""
    synchronize()
    start = time.perf_counter()
    result = action()
    synchronize()
    return result, time.perf_counter() - start


def load_to(device: str, image: str, data: str, quick: bool) -> tuple[Tensor, Tensor | None]:
    """Read an image and its labels to a device."""
    pixels, labels = load(image, data, quick)
    return pixels.to(device), None if labels is None else labels.to(device)


def fit_in_process(image: str, n: int, method: str, device: str, data: str, quick: bool) -> float:
    """Fit an image, and return only the seconds, which another process can receive."""
    pixels, labels = load_to(device, image, data, quick)
    return timed(lambda: fit(pixels, labels, n, recipe=config_of(method, quick)))[1]


@contextmanager
def caches_in(folder: str) -> Iterator[None]:
    """Let new processes keep their compiled code in a folder."""
    before = {name: os.environ.pop(name, None) for name in CACHES}
    os.environ.update(dict.fromkeys(CACHES, folder))
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value


def measure_first_fit(*arguments: Any, new_machine: bool) -> Row:
    """Fit twice in a new process."""
    with TemporaryDirectory() as folder, caches_in(folder) if new_machine else nullcontext():
        start = time.perf_counter()
        with get_context("spawn").Pool(1) as pool:
            first = pool.apply(fit_in_process, arguments)
            whole = time.perf_counter() - start
            return {"seconds": first, "next_seconds": pool.apply(fit_in_process, arguments), "process_seconds": whole}


def measure(image: str, n: int | None, method: str, device: str, data: str, quick: bool) -> list[Row]:
    """Fit an image by one of METHODS; a file, which has no number of Gaussians, has n=None."""
    check_device(device)
    row: Row = {"image": image, "n": n, "method": method}
    if method in FIRST.values():
        assert n is not None
        new_machine = method == FIRST["machine"]
        return [row | measure_first_fit(image, n, method, device, data, quick, new_machine=new_machine)]
    pixels, labels = load_to(device, image, data, quick)
    config = config_of(method, quick)
    with threads(os.cpu_count() or 1):
        if n is None:
            target_bytes = QUICK_FILE_BYTES if quick else FILE_BYTES
            finish(lambda: fit_bytes(pixels, None, target_bytes, recipe=shorten(config)))
            (_, scene, result), seconds = timed(lambda: fit_bytes(pixels, None, target_bytes, recipe=config))
        else:
            warm_up(config, n, (pixels.shape[1], pixels.shape[2]), labels is not None, device)
            result, seconds = timed(lambda: fit(pixels, labels, n, recipe=config))
            scene = result.scene
    render = scene.render()
    row |= {"seconds": seconds, "iterations": result.history[-1].iteration, "psnr": float(psnr(render, pixels))}
    return [row | ({} if labels is None else {"ef_psnr": float(ef_psnr(render, pixels, labels))})]


def jobs(options: Options) -> list[Job]:
    """List fits of photos of Kodak and frames of DAVIS; without data, of photos of scikit-image."""
    plan: list[tuple[str, int | None, str]] = [(image, KODAK_COUNT, GPU) for image in choose(options, "kodak")]
    if options.quick:
        plan = [("disc", 30, method) for method in (GPU, CORES, OTHER, FIRST["process"])]
        plan += [("disc", None, method) for method in (FILE_GPU, FILE_CORES)]
    elif options.data is not None:
        frames = choose(options, "davis")
        plan += [(image, n, GPU) for image in frames for n in DAVIS_COUNTS]
        plan += [(KODAK_COMPARED[0], KODAK_COUNT, FIRST["process"])]
        plan += [(image, n, CORES) for image, n in DAVIS_COMPARED]
        plan += [(image, KODAK_COUNT, method) for method in (CORES, OTHER) for image in KODAK_COMPARED]
        plan += [(image, None, method) for method in (FILE_GPU, FILE_CORES) for image in KODAK_COMPARED]
        plan += [(KODAK_COMPARED[0], KODAK_COUNT, FIRST["machine"])]
    return [
        {"image": image, "n": n, "method": method, "device": METHODS[method][2], **options.image_arguments()}
        for image, n, method in plan
    ]


def page(folder: Path, rows: list[Row]) -> Page:
    """Write the report."""
    rows = [{**row, "set": set_of(row["image"])} for row in rows]
    groups = group_by(rows, ["set", "n", "method"])
    rows = [{**row, "images": len(group)} for group in groups.values() for row in group]
    fits = [row for row in rows if row["method"] not in FIRST.values()]
    panels = [Panel(str(name), group, "seconds", "psnr") for (name,), group in group_by(fits, ["set"]).items()]
    save_lines(folder / "gpu-fit.png", panels, "method", "n")
    means = {
        (str(name), n): {quantity: fmean(values_of(group, quantity)) for quantity in ("seconds", "psnr")}
        for (name, n, method), group in groups.items()
        if method == GPU
    }
    longer = {
        kind: fmean(row["seconds"] - row["next_seconds"] for row in first)
        for kind, method in FIRST.items()
        if (first := [row for row in rows if row["method"] == method])
    }
    goals = [
        Goal(f"{name}, N = {n:,}", quantity, limit, mean[quantity], quantity == "psnr")
        for (name, n), mean in means.items()
        for quantity, limit in GOALS.get(name, {}).items()
    ]
    if "machine" in longer:
        goals.append(Goal("first fit of a machine", "seconds longer", GOAL_OF_A_FIRST_FIT, longer["machine"]))
    sentences = [
        *(
            f"On the GPU `best` takes {m['seconds']:.2g} s for {m['psnr']:.2f} dB ({s}, N = {n:,})."
            for (s, n), m in means.items()
        ),
        *(f"The first fit of a {kind} takes {seconds:.2g} s longer than the next." for kind, seconds in longer.items()),
    ]
    table = means_table(rows, ["set", "n", "method"], "", QUANTITIES)
    methods = {row["method"] for row in rows}
    notes = [text for method, text in NOTES.items() if method in methods]
    losses = join_sections(missed_goals(goals), losses_table(fits, COMPARISONS, ["psnr", "seconds"], ["n"]))
    gains = differences(fits, COMPARISONS, ["psnr", "seconds"], ["set", "n"])
    method = "\n".join([METHOD, *notes])
    return Page(" ".join(sentences), "gpu-fit.png", join_sections(table, goals_table(goals)), losses, method, gains)
