"""Fits that experiments are made of: the missing ones are made, here or on other processors, and all are kept.

`ensure` is for experiments that ask for fits and nothing else; `make_all` for those that keep what they make in files
of their own. Fits whose seconds are compared with each other are to be made one after another: leave `Place` as it is.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

from torch import Tensor

from kcgs.engine import run_jobs
from kcgs.fit import FitConfig, HistoryEntry, fit
from kcgs.functional import RegionMap
from kcgs.io import Scene, load, save
from kcgs.nn.renderer import render_image

from .measure import measure

Job = TypeVar("Job")
_NOTE = "made"


class Place(NamedTuple):
    """Where fits are made: the options --engine and --workers. A fit has one thread: all places give the same."""

    engine: str = "local"
    workers: int | None = None

    @property
    def is_here(self) -> bool:
        """Whether fits run one after another in this process."""
        return self.engine == "local" and self.workers in (None, 1)

    def __str__(self) -> str:
        if self.is_here:
            return "one at a time on one thread"
        count = "as many as there are processors for" if self.workers is None else f"{self.workers}"
        return f"{count} at a time on one thread each, engine {self.engine}"


HERE = Place()


def make_all(
    function: Callable[[Job], object],
    jobs: Sequence[Job],
    place: Place = HERE,
    *,
    name: Callable[[Job], str] = str,
) -> list[str]:
    """Do jobs that keep what they make on disk themselves, with a bar on a terminal.

    Args:
        function: called with one job; importable by name, or a `partial` of such a one, where `place` is not here.
        jobs: what it is called with.
        place: where.
        name: how a job is called on the terminal, and where it fails.

    Returns:
        What is to be said of those that failed, nothing where all is well; see `check_made`.
    """
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    failed: list[str] = []
    done = run_jobs(function, jobs, engine=place.engine, workers=place.workers)
    with Progress(console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task(name(jobs[0]) if jobs else "", total=len(jobs))
        for number, ended in enumerate(done, 1):
            if ended.error is not None:
                failed.append(f"{name(jobs[ended.index])}: {ended.error}")
            # here it is the next one that runs, elsewhere several do
            shown = min(number, len(jobs) - 1) if place.is_here else ended.index
            progress.update(task, advance=1, description=name(jobs[shown]))
    return failed


def check_made(failed: Sequence[str]) -> None:
    """Raise once all that could be done is done.

    Args:
        failed: what `make_all` returned.

    Raises:
        RuntimeError: there is something in it; the message holds it.
    """
    if failed:
        raise RuntimeError(f"fits failed, {len(failed)} of them: {'; '.join(failed)}")


class Spec(NamedTuple):
    """One fit: of what, and how."""

    image: Tensor
    """(C, H, W)."""
    regions: RegionMap | Tensor | None
    num_gaussians: int
    config: FitConfig
    seed: int = 0
    band: Tensor | None = None
    """Label map whose contours the edge-focused figures look at; None: that of `regions`, where there are any."""
    name: str = ""
    """What people read; the result does not depend on it."""

    def key(self) -> str:
        """Hash everything that the result depends on."""
        digest = hashlib.sha256(f"{self.config.model_dump_json()} {self.num_gaussians} {self.seed}".encode())
        _add(digest.update, self.image)
        regions = self.regions
        if isinstance(regions, RegionMap):
            digest.update(repr((regions.softness, regions.supersample)).encode())
            regions = regions.fine_labels
        _add(digest.update, regions)
        _add(digest.update, self.band)
        return digest.hexdigest()[:20]

    def path(self, folder: Path) -> Path:
        """Return the file that the result is kept in."""
        return folder.absolute() / f"{self.key()}.safetensors"


class Fitted(NamedTuple):
    """A finished fit: its figures; the scene is read when it is asked for."""

    path: Path
    psnr: float
    ef_psnr: float
    ssim: float
    ms_ssim: float
    ef_ssim: float
    seconds: float
    """Of the whole call, compilation excluded: wall time, in which other work on the machine is."""
    core_seconds: float
    """Of the same call: processor time, all threads."""
    num_gaussians: int
    stop_reason: str
    history: tuple[HistoryEntry, ...]

    def scene(self) -> Scene:
        """Read the scene."""
        return load(self.path)


def ensure(specs: Iterable[Spec], folder: Path, *, engine: str = "local", workers: int | None = None) -> list[Fitted]:
    """Return the results of all fits, after making those that are not in the folder yet.

    Each is a scene with its figures in it, written whole or not at all, under a hash of image, regions and settings.
    Remove the folder to measure changed code anew.

    Args:
        specs: the fits; one that is there twice is made once.
        folder: made where it is missing; on a cluster all nodes must see it.
        engine: local or ray.
        workers: fits at a time; None: one locally, and on Ray what its processors allow.

    Returns:
        One result for each spec, in their order.

    Raises:
        RuntimeError: fits failed; the others are in the folder. The message names them.

    Example:
        >>> import tempfile, torch
        >>> config = FitConfig.from_recipe("paper", iterations=5)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     first, again = (ensure([Spec(torch.zeros(3, 16, 24), None, 4, config)], Path(folder)) for _ in "12")
        >>> first[0].num_gaussians, first == again
        (4, True)
    """
    folder = folder.absolute()
    folder.mkdir(parents=True, exist_ok=True)
    wanted = [(spec.path(folder), spec) for spec in specs]
    missing = {path: spec for path, spec in wanted if not path.is_file()}
    place = Place(engine, workers)
    check_made(make_all(_make, list(missing.items()), place, name=lambda job: job[1].name or job[0].stem))
    return [_read(path) for path, _ in wanted]


def ensure_one(spec: Spec, folder: Path) -> Fitted:
    """Return one result, after making it here where it is not in the folder yet: `ensure` within a job of one's own."""
    path = spec.path(folder)
    if not path.is_file():
        _make((path, spec))
    return _read(path)


def _make(job: tuple[Path, Spec]) -> None:
    from kcgs.fit import warm_up

    path, spec = job
    warm_up(spec.config)
    regions = RegionMap.from_labels(spec.regions) if isinstance(spec.regions, Tensor) else spec.regions
    start, core_start = time.perf_counter(), time.process_time()
    result = fit(spec.image, regions, spec.num_gaussians, config=spec.config, seed=spec.seed)
    seconds, core_seconds = time.perf_counter() - start, time.process_time() - core_start
    band = spec.band if spec.band is not None or regions is None else regions.labels
    made = {
        **measure(render_image(result.field, result.regions), spec.image, band),
        "seconds": seconds,
        "core_seconds": core_seconds,
        "num_gaussians": len(result.field),
        "stop_reason": result.stop_reason,
        "history": result.history,
    }
    notes = {"name": spec.name, "settings": spec.config.model_dump_json(), _NOTE: json.dumps(made)}
    save(path, result.field, result.regions, metadata=notes)


def _read(path: Path) -> Fitted:
    made = json.loads(load(path).metadata[_NOTE])
    return Fitted(**{**made, "path": path, "history": tuple(HistoryEntry(*entry) for entry in made["history"])})


def _add(update: Callable[[bytes], object], tensor: Tensor | None) -> None:
    if tensor is None:
        update(b"none")
        return
    update(f"{tensor.dtype} {tuple(tensor.shape)}".encode())
    update(tensor.cpu().contiguous().numpy().tobytes())
