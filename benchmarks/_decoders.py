"""What the benchmark of decoders races: scenes, and their decoders from files to a function that renders."""

from __future__ import annotations

import copy
import statistics
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcgs.functional import RegionMap
from kcgs.kernels.octaves import direct
from kcgs.nn import GaussianField
from kcgs.onnx import generic_decoder, scene_decoder, write_model
from kcgs.scene import Scene, load

from ._render_runs import DIRECT, EXACT, TRUTH_CUTOFF, renderer, second
from ._workloads import FITTED, STANDARD, WIDE, resized, standard, workload
from .core.cases import BEST, QUICK_ITERATIONS, Case
from .core.clocks import clock, in_turns, threads
from .core.jobs import check_made
from .core.options import Options
from .core.store import Store

SCENE, GENERIC, CPU, TILED = "onnxruntime, scene", "onnxruntime, generic", "torch, cpu", "torch, tiled"
# without coarse grids
SCENE_DIRECT, CPU_DIRECT = f"{SCENE}, direct", f"torch, {DIRECT}"
DECODERS = (SCENE, SCENE_DIRECT, GENERIC, CPU, CPU_DIRECT, TILED)
# the others take seconds for a wide image
FAST = (SCENE, SCENE_DIRECT, CPU, CPU_DIRECT)
CONTOURS = ("none", "hard", "soft")
SOFTNESS = 0.7
SEQUENCE = "blackswan"
QUICK_SIZE, QUICK_COUNT, QUICK_STRIDE = (48, 64), 60, 8
WORKLOADS = {name: STANDARD[name] for name in ("W1", "W2")}

Render = Callable[[], Tensor]


class Entrant(NamedTuple):
    """Who runs: a decoder, its threads, its cutoff."""

    decoder: str
    threads: int
    cutoff: float


class Subject(NamedTuple):
    """A scene to decode."""

    name: str
    source: str
    scene: Scene
    is_fitted: bool = False

    @property
    def contours(self) -> str:
        """none, hard or soft, as a decoder's metadata has it."""
        regions = self.scene.regions
        if regions is None or regions.num_regions == 1:
            return "none"
        return "hard" if regions.softness == 0.0 else "soft"

    @property
    def is_typical(self) -> bool:
        """Whether these are the contours that its figure and its memory are measured with."""
        return self.contours == ("soft" if self.is_fitted else "hard")

    @property
    def about(self) -> str:
        """What a reader must know of it."""
        (height, width), regions = self.scene.size, self.scene.regions
        count = 1 if regions is None else regions.num_regions
        numbers = f"{height} x {width}, N = {self.scene.num_gaussians:,}, regions: {count}, contours: {self.contours}"
        return f"{self.source}; {numbers}"


class Files(NamedTuple):
    """What decoders read, and the cutoff that they have."""

    scene: Path
    decoder: Path
    direct: Path
    generic: Path
    cutoff: float


def standard_subjects(quick: bool) -> list[Subject]:
    """Make the renderer benchmark's workloads, each with no regions, with hard contours and with soft ones."""
    made = []
    for name, numbers in {"small": (*QUICK_SIZE, QUICK_COUNT)}.items() if quick else WORKLOADS.items():
        hard = workload(*numbers)
        assert hard.regions is not None
        field = hard.field
        plain = GaussianField(field.means, field.cholesky, field.colors, size=field.size)
        soft = Scene(field, RegionMap.from_labels(hard.regions.labels, SOFTNESS))
        for contours, scene in zip(CONTOURS, (Scene(plain), hard, soft), strict=True):
            made.append(Subject(f"{name} {contours}", f"workload {name} of `python -m benchmarks render`", scene))
    return made


def zoo_subjects() -> list[Subject]:
    """Read the fitted scenes of the zoo, each with its soft contours and with hard ones."""
    names = [(name, f"{name} {contours}") for name in FITTED for contours in ("soft", "hard")]
    return [Subject(name, f"{fitted} of the zoo", standard(name), is_fitted=True) for fitted, name in names]


def fitted_subjects(output: Path, options: Options) -> list[Subject]:
    """Fit an image; fits are kept, so that the next run need not make them again."""
    if why_not_fitted(options) is not None:
        return []
    quick: dict[str, Any] = {}
    name, counts = SEQUENCE, [n for _, _, n in WORKLOADS.values()]
    if options.quick or options.data is None:
        name, counts, quick = "astronaut", [QUICK_COUNT], {"iterations": QUICK_ITERATIONS, "stride": QUICK_STRIDE}
    cases, store = [Case(name, n, BEST, **quick) for n in counts], Store.open(output, options)
    check_made(store.obtain(cases, options.place))
    made = []
    for case, row in zip(cases, store.rows(cases), strict=True):
        source = f"{name} fitted by recipe {BEST.recipe} with {case.n:,} Gaussians, {row.psnr:.2f} dB"
        made.append(Subject(f"{name} {case.n}", source, store.scene(case), is_fitted=True))
    return made


def why_not_fitted(options: Options) -> str | None:
    """Say why there are no fitted scenes; None: there are."""
    if options.quick:
        return None
    if options.data is None:
        return "no folder with images was given (--data)"
    return None if (options.data / "DAVIS").is_dir() else "there is no folder DAVIS in the data"


def write_files(folder: Path, scene: Scene, cutoff: float) -> Files:
    """Write a scene and its decoders into a folder, which is made."""
    folder.mkdir(parents=True)
    paths = folder / "scene.safetensors", folder / "scene.onnx", folder / "direct.onnx", folder / "generic.onnx"
    files = Files(*paths, cutoff)
    scene.save(files.scene)
    write_model(scene_decoder(scene, cutoff=cutoff, clamp=False), files.decoder)
    with direct():
        write_model(scene_decoder(scene, cutoff=cutoff, clamp=False), files.direct)
    write_model(generic_decoder(cutoff=cutoff, clamp=False), files.generic)
    return files


def decoders_of(scene: Scene, size: str = "native") -> list[str]:
    """List the decoders to time at a size."""
    return list(FAST if size == WIDE else DECODERS)


def open_decoder(name: str, files: Files, size: tuple[int, int], threads: int) -> Render:
    """Read the files and return what renders (C, H, W) at that size; torch has its own setting of threads."""
    if name in (SCENE, SCENE_DIRECT):
        return _session(files.decoder if name == SCENE else files.direct, {"size": np.array(size, np.int64)}, threads)
    placed = resized(load(files.scene), size)
    if name == GENERIC:
        return _session(files.generic, _generic_feeds(placed), threads)
    return lambda: _splat(placed, name.removeprefix("torch, "), files.cutoff)


def open_and_render(name: str, files: Files, size: tuple[int, int]) -> Tensor:
    """Open a decoder and render one image, on one thread."""
    return open_decoder(name, files, size, 1)()


def race(renders: Mapping[Entrant, Render], rounds: int) -> dict[Entrant, list[float]]:
    """Time rendering in turns; seconds of each round."""

    def timed(entrant: Entrant) -> float:
        with threads(entrant.threads):
            return second(renders[entrant])

    return in_turns({entrant: partial(timed, entrant) for entrant in renders}, rounds)


def load_seconds(name: str, files: Files, size: tuple[int, int], rounds: int) -> float:
    """Time a decoder from its files until it is ready to render, on one thread, after one run to warm up."""
    with threads(1):
        seconds = [clock(partial(open_decoder, name, files, size, 1)) for _ in range(rounds + 1)]
    return statistics.median(seconds[1:])


def truth(scene: Scene, size: tuple[int, int]) -> Tensor:
    """Render in float64, tile by tile at a cutoff next to nothing."""
    return _splat(resized(copy.deepcopy(scene).double(), size), EXACT, TRUTH_CUTOFF)


def _splat(scene: Scene, backend: str, cutoff: float) -> Tensor:
    with torch.inference_mode():
        return renderer(backend)(scene, cutoff)


def _session(path: Path, feeds: dict[str, Any], threads: int) -> Render:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    # idle threads would go on spinning while the next decoder is timed
    options.add_session_config_entry("session.force_spinning_stop", "1")
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    return lambda: torch.from_numpy(session.run(["image"], feeds)[0])[0]


def _generic_feeds(scene: Scene) -> dict[str, Any]:
    field = scene.field
    memberships, region_ids = torch.ones(1, *field.size), torch.zeros(field.num_gaussians, dtype=torch.int64)
    if (regions := scene.regions) is not None and field.region_ids is not None:
        memberships = torch.stack([regions.weights(region).float() for region in regions.ids.tolist()])
        region_ids = regions.index_of(field.region_ids)
    tensors = {"means": field.means, "cholesky": field.cholesky, "colors": field.colors}
    tensors |= {"region_ids": region_ids, "memberships": memberships}
    return {name: tensor.detach().numpy() for name, tensor in tensors.items()}
