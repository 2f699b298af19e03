"""Fits on disk, each with the file that it makes and what both measure; what is there is not made again."""

from __future__ import annotations

import hashlib
import json
import math
import os
import time
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from kcgs._atomic import write_file
from kcgs.codec import decode, encode
from kcgs.codec.labels import encode_map
from kcgs.evaluation import measure
from kcgs.fitting import FitResult, HistoryEntry, fit, warm_up
from kcgs.rate import quality_for
from kcgs.scene import Scene, load
from kcgs.segment import segment

from . import eye
from .cases import QUICK_ITERATIONS, Case
from .jobs import Place, make_all
from .options import Options

_FIGURES = ("psnr", "ms_ssim", "ef_psnr", "ef_ssim")


class Row(NamedTuple):
    """A finished fit: its image's figures, and those of the file that is all a decoder needs."""

    image: str
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
    note: str = ""
    ssimulacra2: float = math.nan  # of the scene, measured afterwards, like butteraugli, where that can be
    butteraugli: float = math.nan

    @property
    def bits_per_pixel(self) -> float:
        """Size of the file."""
        return 8 * self.bytes / self.pixels


class Kept(NamedTuple):
    """What is kept of a fit beside its scene."""

    row: Row
    history: tuple[HistoryEntry, ...]
    given_regions: int  # of the map that came in
    segment_seconds: float  # that finding the map took; 0: it was given


class Store:
    """Fits in a folder, under a hash of all that they depend on; benches that share it share their fits.

    Remove the folder to measure changed code anew; on a cluster all nodes must see it.
    """

    def __init__(self, folder: Path, data: Path | None) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder.absolute()
        self.data = None if data is None else data.absolute()

    @classmethod
    def open(cls, output: Path, options: Options) -> Store:
        """Open the folder of the fits."""
        return cls(output / "runs" if options.runs is None else options.runs, options.data)

    def kept(self, case: Case) -> Kept | None:
        """Return what is kept of a case; None: it is not there."""
        path = self._path(case)
        if not (path.is_file() and path.with_suffix(".safetensors").is_file()):
            return None
        fields = json.loads(path.read_text(encoding="utf-8"))
        history = tuple(HistoryEntry(*entry) for entry in fields["history"])
        return Kept(**{**fields, "row": Row(*fields["row"]), "history": history})

    def row(self, case: Case) -> Row | None:
        """Return the row of a case; None: it is not there."""
        kept = self.kept(case)
        return None if kept is None else kept.row

    def look(self, case: Case) -> None:
        """Add what the eye sees to a row that is there."""
        kept = self.kept(case)
        if kept is not None:
            row = eye.look(kept.row, lambda: (self.scene(case).render(), case.load(self.data).image))
            if row is not kept.row:
                write_file(self._path(case), json.dumps(kept._replace(row=row)._asdict()))

    def rows(self, cases: Iterable[Case]) -> list[Row]:
        """Return the rows that are there, each once."""
        return [row for case in dict.fromkeys(cases) if (row := self.row(case)) is not None]

    def scene(self, case: Case) -> Scene:
        """Read the scene of a case."""
        return load(self._path(case).with_suffix(".safetensors"))

    def obtain(self, cases: Iterable[Case], place: Place, deadline: float | None = None) -> list[str]:
        """Make what is missing but what would not be done by `deadline` of the monotonic clock; return what failed."""
        missing = [case for case in dict.fromkeys(cases) if self.row(case) is None]
        if deadline is None:
            return make_all(self.make, missing, place)
        parallel = 1 if place.is_local else place.workers or os.cpu_count() or 1
        failed: list[str] = []
        for first in range(0, len(missing), parallel):
            part, known = missing[first : first + parallel], self._known()
            if time.monotonic() + max(known.get(case.settings(), 0.0) for case in part) <= deadline:
                failed += make_all(self.make, part, place)
        return failed

    def make(self, case: Case) -> None:
        """Fit, encode, measure, and keep."""
        begin = time.monotonic()
        (image, labels), config = case.load(self.data), case.config()
        if config.usual_iterations > QUICK_ITERATIONS:  # the quick form's seconds mean nothing
            warm_up(config)
        labels, segment_seconds = find_labels(case.source, image, labels)
        start, core_start = time.perf_counter(), time.process_time()
        result = fit(image, case.regions(labels), case.n, recipe=config, seed=case.seed)
        seconds, core_seconds = time.perf_counter() - start, time.process_time() - core_start
        row = _measure(case, result, image, labels)._replace(seconds=seconds, core_seconds=core_seconds)
        given_regions = 1 if labels is None else len(torch.unique(labels))
        kept = Kept(row, tuple(result.history), given_regions, segment_seconds)
        path = self._path(case)
        result.scene.save(path.with_suffix(".safetensors"))
        write_file(path, json.dumps(kept._asdict()))
        self._learn(case, time.monotonic() - begin)

    def _path(self, case: Case) -> Path:
        fields = [name for name in Row._fields if name not in eye.MEASURES]
        parts = [case.image, case.seed, case.stride, case.source, str(self.data), fields, case.settings()]
        parts += [case.factor] if case.factor > 1 else []
        key = hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:20]
        return self.folder / f"{case.image}-{case.n}-{key}.json"

    def _known(self) -> dict[str, float]:
        """Read what the slowest fit of each N and settings took: a file beside them, for the next call."""
        path = self.folder / "seconds.json"
        known: dict[str, float] = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
        return known

    def _learn(self, case: Case, seconds: float) -> None:
        known = self._known()
        known[case.settings()] = max(seconds, known.get(case.settings(), 0.0))
        write_file(self.folder / "seconds.json", json.dumps(known))


def _measure(case: Case, result: FitResult, image: Tensor, labels: Tensor | None) -> Row:
    """Measure a scene and its file; seconds are put in by who has them."""
    scene = result.scene
    figures = measure(scene.render(), image, labels)
    data = encode(scene, quality=quality_for(figures["psnr"]))
    decoded = measure(decode(data).scene.render(), image, labels)
    fields: dict[str, Any] = {name: figures[name] for name in _FIGURES}
    fields |= {f"decoded_{name}": decoded[name] for name in _FIGURES}
    return Row(
        image=case.image, n=case.n, method=case.method.name, seed=case.seed, iterations=result.config.usual_iterations,
        **fields, seconds=math.nan, core_seconds=math.nan, num_gaussians=scene.num_gaussians, pixels=image[0].numel(),
        bytes=len(data),
        map_bytes=len(encode_map(scene.regions)) if scene.regions is not None and scene.regions.num_regions > 1 else 0,
    )  # fmt: skip


def find_labels(source: str, image: Tensor, given: Tensor | None) -> tuple[Tensor | None, float]:
    """Return the map of a source, and the seconds that finding it took, what it imports excluded."""
    if source in ("given", "none"):
        return (given if source == "given" else None), 0.0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        segment(torch.linspace(0.0, 1.0, 64).expand(3, 48, 64), source)
    start = time.perf_counter()
    labels = segment(image, source)
    return labels, time.perf_counter() - start
