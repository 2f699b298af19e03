"""One fit, measured, and kept on disk as soon as it is done."""

from __future__ import annotations

import dataclasses
import json
import time
from pathlib import Path

from kcgs._atomic import atomic_path
from kcgs.bench.measure import measure
from kcgs.bench.sizes import GAUSSIAN_BYTES, stored_bytes
from kcgs.fit import HistoryEntry, fit, warm_up
from kcgs.nn.renderer import render_image

from .cases import BASELINE, COMPARED, Case, load


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run:
    """A finished fit: what was asked, what came out."""

    group: str
    image: str
    n: int
    name: str
    seed: int = 0
    psnr: float
    ef_psnr: float
    ssim: float
    ms_ssim: float
    ef_ssim: float
    seconds: float  # of the whole call
    num_gaussians: int  # what is left of n
    given_bytes: int  # of the label map that came in, 0: none
    map_bytes: int  # of the label map that must be stored, 0: none
    iterations: int
    stop_reason: str
    history: tuple[HistoryEntry, ...] = ()

    @property
    def bytes(self) -> int:
        """Size of the scene: 7 bytes a Gaussian, and the label map."""
        return GAUSSIAN_BYTES * self.num_gaussians + self.map_bytes


class Store:
    """Runs in a folder, a JSON file each, named by a hash of the case and its settings."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder

    def read(self, case: Case) -> Run | None:
        """Return the run of a case, None where there is none."""
        path = self._path(case)
        if not path.is_file():
            return None
        kept = json.loads(path.read_text(encoding="utf-8"))
        return Run(**{**kept["run"], "history": tuple(HistoryEntry(*entry) for entry in kept["run"]["history"])})

    def write(self, case: Case, run: Run) -> None:
        """Keep a run."""
        # the case and its settings are there for who reads the file
        kept = {
            "recipe": case.recipe,
            "overrides": case.overrides,
            "settings": case.config().model_dump(mode="json"),
            "run": dataclasses.asdict(run),
        }
        with atomic_path(self._path(case)) as temporary:
            temporary.write_text(json.dumps(kept), encoding="utf-8")

    def _path(self, case: Case) -> Path:
        # what is recorded is part of the name: files of another form are not read
        return self.folder / f"{case.group}-{case.key(*(f.name for f in dataclasses.fields(Run)))}.json"


def equal_bytes(case: Case, run: Run) -> Case | None:
    """Return the baseline's fit with the Gaussians that the bytes of `run` buy; None where none is asked for."""
    if COMPARED.get(case.group) != case.name:
        return None
    # what cuts the quick form short cuts this short too
    overrides = {key: value for key, value in case.overrides.items() if key == "iterations"}
    return case._replace(n=affordable(run), name=BASELINE, recipe=BASELINE, overrides=overrides)


def affordable(run: Run) -> int:
    """Gaussians without a map in the bytes of `run`."""
    return run.bytes // GAUSSIAN_BYTES


def perform(case: Case, data: Path | None) -> Run:
    """Fit and measure; edge-focused figures are taken along the contours of the map that was given."""
    problem, config = load(case, data), case.config()
    warm_up(config)
    start = time.perf_counter()
    result = fit(problem.image, problem.regions, case.n, config=config, seed=case.seed)
    seconds = time.perf_counter() - start
    figures = measure(render_image(result.field, result.regions), problem.image, problem.labels)
    return Run(
        group=case.group,
        image=case.image,
        n=case.n,
        name=case.name,
        seed=case.seed,
        seconds=seconds,
        num_gaussians=len(result.field),
        given_bytes=stored_bytes(problem.regions),
        map_bytes=stored_bytes(result.regions),
        iterations=result.history[-1].iteration,
        stop_reason=result.stop_reason,
        history=tuple(result.history),
        **figures,
    )
