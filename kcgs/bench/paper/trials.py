"""One fit, the file that it makes, and what both measure; kept on disk as soon as it is done."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from kcgs._atomic import atomic_path
from kcgs.bench.fits import Place, Spec, ensure_one, make_all
from kcgs.bench.measure import measure
from kcgs.bench.sizes import write_scene
from kcgs.codec import decode
from kcgs.codec.labels import encode_map
from kcgs.fit import FitConfig, HistoryEntry, warm_up
from kcgs.io import Scene, load
from kcgs.nn.renderer import render_image

from . import pictures
from .methods import COVERAGE, QUICK_ITERATIONS, Method

# what files of about as many bytes are aimed at, may have, and how many fits that may take
_ABOVE, _NEAR, _TRIES = 1.03, 1.06, 4


class Trial(NamedTuple):
    """What is fitted, with how many Gaussians, how."""

    picture: str
    n: int
    method: Method
    seed: int = 0
    iterations: int | None = None  # None: the recipe's own
    stride: int = 1  # of so many pixels one is taken

    def config(self) -> FitConfig:
        """All settings."""
        return self.method.config(self.iterations)

    def __str__(self) -> str:
        return f"{self.picture}, N = {self.n:,}, {self.method.name}" + (f", seed {self.seed}" if self.seed else "")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """A finished fit: its picture's figures, and those of the file that is all a decoder needs."""

    picture: str
    n: int
    method: str
    seed: int
    iterations: int
    psnr: float
    ms_ssim: float
    ef_psnr: float
    ef_ssim: float
    seconds: float  # wall time of the fit, compilation excluded
    core_seconds: float  # its processor time
    num_gaussians: int  # what is left of n
    pixels: int
    bytes: int  # of the .kcgs file
    map_bytes: int  # of these the label map's, contour widths included
    decoded_psnr: float
    decoded_ms_ssim: float
    decoded_ef_psnr: float
    decoded_ef_ssim: float
    scene: str  # file
    history: tuple[HistoryEntry, ...] = ()

    @property
    def bits_per_pixel(self) -> float:
        """Size of the file."""
        return 8 * self.bytes / self.pixels


class Store:
    """Rows and scenes in a folder; benches that share it share their fits."""

    def __init__(self, folder: Path, data: Path | None) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder.absolute()
        self.data = None if data is None else data.absolute()

    def read(self, trial: Trial) -> Row | None:
        """Return the row of a trial, None where it is not there."""
        path = self._path(trial)
        if not path.is_file():
            return None
        kept = json.loads(path.read_text(encoding="utf-8"))
        row = Row(**{**kept, "history": tuple(HistoryEntry(*entry) for entry in kept["history"])})
        return row if (self.folder / row.scene).is_file() else None

    def rows(self, trials: Iterable[Trial]) -> list[Row]:
        """Return the rows that are there, each once."""
        return [row for trial in dict.fromkeys(trials) if (row := self.read(trial)) is not None]

    def scene(self, row: Row) -> Scene:
        """Read the scene of a row."""
        return load(self.folder / row.scene)

    def make(self, trial: Trial) -> None:
        """Fit, encode, measure, and keep."""
        row = _perform(trial, self.data, self.folder)
        with atomic_path(self._path(trial)) as temporary:
            temporary.write_text(json.dumps(dataclasses.asdict(row)), encoding="utf-8")

    def obtain(self, trials: Sequence[Trial], place: Place, deadline: float | None = None) -> list[str]:
        """Make what is missing, leaving out what would not be done by `deadline` of the monotonic clock.

        Returns:
            What is to be said of those that failed.
        """
        missing = [trial for trial in dict.fromkeys(trials) if self.read(trial) is None]
        if deadline is None:
            return make_all(self.make, missing, place, name=str)
        at_once = 1 if place.is_here else place.workers or os.cpu_count() or 1
        failed: list[str] = []
        for first in range(0, len(missing), at_once):
            part = missing[first : first + at_once]
            if time.monotonic() + max(map(self._expected, part)) <= deadline:
                failed += make_all(self.make, part, place, name=str)
        return failed

    def approach(
        self, trials: Sequence[Trial], ours: Method, other: Method, place: Place, deadline: float | None = None
    ) -> list[str]:
        """Make files of another method of about as many bytes as ours; see `rivals`."""
        failed: list[str] = []
        for _ in range(_TRIES):
            failed += self.obtain(rivals(self, trials, ours, other), place, deadline)
            if failed:
                break  # what could not be made would be tried again
        return failed

    def _expected(self, trial: Trial) -> float:
        """Return the seconds that the slowest fit took with these settings and N."""
        return _known(self.folder).get(_settings(trial), 0.0)

    def _path(self, trial: Trial) -> Path:
        fields = [field.name for field in dataclasses.fields(Row)]
        parts = [trial.picture, trial.seed, trial.stride, str(self.data), fields, _settings(trial)]
        key = hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:20]
        return self.folder / f"{trial.picture}-{trial.n}-{key}.json"


def plan(
    names: Iterable[str],
    counts: Iterable[int],
    methods: Sequence[Method],
    *,
    seeds: int = 1,
    iterations: int,
    stride: int = 1,
    quick: bool = False,
) -> list[Trial]:
    """List trials, picture by picture, N by N; `iterations` are those of the published recipes."""
    counts = list(counts)
    return [
        Trial(name, n, m, seed, QUICK_ITERATIONS if quick else iterations if m.is_published else None, stride)
        for name in names
        for n in counts
        for seed in range(seeds)
        for m in methods
    ]


def rivals(store: Store, trials: Iterable[Trial], ours: Method, other: Method) -> list[Trial]:
    """Return fits of the other method with about the Gaussians that the bytes of ours buy.

    They are found one after another: those that are made already, and of each at most one that is not.
    """
    trials = list(dict.fromkeys(trials))
    found = []
    for trial in trials:
        beside = next((t for t in trials if t.method == other and _is_beside(t, trial)), None)
        if trial.method == ours and beside is not None:
            mine, theirs = store.read(trial), store.read(beside)
            if mine is not None and theirs is not None:
                found += _approach(store, beside, theirs, mine.bytes)
    return found


def _approach(store: Store, first: Trial, row: Row, size: int) -> list[Trial]:
    """Return fits ever nearer to `size` bytes, until one has as many, or little more, or is not made yet."""
    made, found = {row.n: row.bytes}, list[Trial]()
    while len(found) < _TRIES and not any(size <= count <= _NEAR * size for count in made.values()):
        trial = first._replace(n=_guess(made, _ABOVE * size))
        if trial.n in made:
            break
        found.append(trial)
        reached = store.read(trial)
        if reached is None:
            break
        made[trial.n] = reached.bytes
    return found


def _guess(made: dict[int, int], size: float) -> int:
    """Return the N of so many bytes, by the line through the two nearest files, or through the only one and nothing."""
    (n, count), (other, beside) = sorted([*made.items(), (0, 0)], key=lambda point: abs(point[1] - size))[:2]
    return n + 1 if count == beside else max(1, 1 + math.ceil(n + (size - count) * (n - other) / (count - beside)))


def near(rows: Iterable[Row], row: Row, method: str) -> Row | None:
    """Return the file of another method with as many bytes as a row's, or little more, the nearest one."""
    there = [r for r in rows if (r.picture, r.seed, r.method) == (row.picture, row.seed, method)]
    there = [r for r in there if row.bytes <= r.bytes <= _NEAR * row.bytes]
    return min(there, key=lambda r: r.bytes, default=None)


def _is_beside(one: Trial, other: Trial) -> bool:
    return (one.picture, one.n, one.seed) == (other.picture, other.n, other.seed)


def _settings(trial: Trial) -> str:
    return f"{trial.n} {trial.method.name} {trial.config().model_dump_json()}"


def _known(folder: Path) -> dict[str, float]:
    """Read how long fits took: a file beside them, so that one goes on with what an earlier call learned."""
    path = folder / "seconds.json"
    known: dict[str, float] = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    return known


def _learn(folder: Path, trial: Trial, seconds: float) -> None:
    known = _known(folder)
    known[_settings(trial)] = max(seconds, known.get(_settings(trial), 0.0))
    with atomic_path(folder / "seconds.json") as temporary:
        temporary.write_text(json.dumps(known), encoding="utf-8")


def _perform(trial: Trial, data: Path | None, folder: Path) -> Row:
    image, labels = pictures.load(trial.picture, data, trial.stride)
    config = trial.config()
    regions = pictures.coverage_map() if trial.method == COVERAGE and trial.stride == 1 else labels
    spec = Spec(image, regions, trial.n, config, trial.seed, labels, str(trial))
    is_new = not spec.path(folder).is_file()
    if config.iterations > QUICK_ITERATIONS:  # the quick form's seconds mean nothing
        warm_up(config)
    began = time.monotonic()
    fitted = ensure_one(spec, folder)
    scene = fitted.scene()
    data_bytes = write_scene(scene.field, scene.regions, fitted.psnr)
    held = decode(data_bytes)
    figures = measure(render_image(held.field, held.regions), image, labels)
    has_map = scene.regions is not None and scene.regions.num_regions > 1
    if is_new:
        _learn(folder, trial, time.monotonic() - began)
    made: dict[str, Any] = {f"decoded_{key}": figures[key] for key in ("psnr", "ms_ssim", "ef_psnr", "ef_ssim")}
    return Row(
        picture=trial.picture,
        n=trial.n,
        method=trial.method.name,
        seed=trial.seed,
        iterations=config.iterations,
        psnr=fitted.psnr,
        ms_ssim=fitted.ms_ssim,
        ef_psnr=fitted.ef_psnr,
        ef_ssim=fitted.ef_ssim,
        seconds=fitted.seconds,
        core_seconds=fitted.core_seconds,
        num_gaussians=fitted.num_gaussians,
        pixels=labels.numel(),
        bytes=len(data_bytes),
        map_bytes=len(encode_map(scene.regions)) if has_map and scene.regions is not None else 0,
        scene=fitted.path.name,
        history=fitted.history,
        **made,
    )
