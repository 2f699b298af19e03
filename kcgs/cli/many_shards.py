"""The job that `kcgs fit-many --shard` runs for a batch of images: a part of a shard; and shards from their parts."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from .common import describe_error
from .many_jobs import FitJob, Loaded, Outcome, describe_settings, fit_batch, load_job


class ShardPart(NamedTuple):
    """Images that are fitted together, and where their scenes go until the shard is complete."""

    shard: Path
    number: int
    """Of the part in the shard."""
    images: tuple[FitJob, ...]
    size: tuple[int, int] | None
    """(height, width) of all of them, as far as their files say it."""
    fingerprint: str
    """Of the whole shard."""

    @property
    def path(self) -> Path:
        """The file of the part."""
        return self.shard.with_name(f"{self.shard.stem}.part{self.number:04d}.safetensors")

    def is_done(self) -> bool:
        """Whether the scenes of the part are on disk."""
        return any(_notes(path).get("fingerprint") == self.fingerprint for path in (self.shard, self.path))


def fingerprint_of(jobs: Sequence[FitJob]) -> str:
    """Hash the settings, and the names and sizes of images and masks, but not their contents: there may be millions."""
    files = [(job.image.name, _bytes(job.image), _bytes(Path(job.regions)) or job.regions) for job in jobs]
    return hashlib.sha256(repr((describe_settings(jobs[0]), files)).encode()).hexdigest()


def _bytes(path: Path) -> int | None:
    return path.stat().st_size if path.is_file() else None


def fit_part(part: ShardPart) -> list[Outcome]:
    """Fit the images of a part, and write their scenes, unless the shard or the part is there."""
    for path in (part.shard, part.path):
        if (kept := _read_kept(part, path)) is not None:
            return kept
    outcomes: dict[int, Outcome] = {}
    loaded: dict[int, Loaded] = {}
    for index, job in enumerate(part.images):
        try:
            one = load_job(job)
            size = (one.image.shape[1], one.image.shape[2])
            if part.size not in (None, size):
                raise ValueError(f"it has {size[1]} x {size[0]} pixels, its file says another size")
            loaded[index] = one
        except Exception as error:
            outcomes[index] = Outcome({"error": describe_error(error)}, True)
    if loaded:
        outcomes |= _fit_and_save(part, loaded, {index: outcome.row["error"] for index, outcome in outcomes.items()})
    return [outcomes[index] for index in range(len(part.images))]


def _fit_and_save(part: ShardPart, loaded: dict[int, Loaded], errors: dict[int, str]) -> dict[int, Outcome]:
    """Fit images of one shape, and write the part."""
    from kcgs.data import save_shard, stack_scenes
    from kcgs.fitting import rank_gaussians
    from kcgs.nn import reorder_rows
    from kcgs.scene import Scene

    request = part.images[0].request
    try:
        fits = fit_batch([*loaded.values()], request)
    except Exception as error:  # of all of them: their images and maps were read
        return {index: Outcome({"error": describe_error(error)}, True) for index in loaded}
    scenes = stack_scenes([fit.result.scene for fit in fits], request.num_gaussians)
    field = reorder_rows(scenes.field, rank_gaussians(scenes.field, scenes.regions))
    scenes = Scene(field, scenes.regions).to("cpu")
    names = [part.images[index].image.name for index in loaded]
    psnr = [float(fit.result.psnr) for fit in fits]
    rows = [
        {"psnr": fit.result.psnr, "num_gaussians": fit.result.scene.num_gaussians, "seconds": fit.seconds}
        for fit in fits
    ]
    failed = {part.images[index].image.name: error for index, error in errors.items()}
    notes = {"fingerprint": part.fingerprint, "rows": json.dumps(rows), "errors": json.dumps(failed)}
    save_shard(part.path, scenes, names, psnr, notes)
    return {
        index: Outcome(row, True, (*one.warnings, *fit.warnings))
        for (index, one), fit, row in zip(loaded.items(), fits, rows, strict=True)
    }


def _read_kept(part: ShardPart, path: Path) -> list[Outcome] | None:
    """Return the rows of a part that are in a file of the same images and settings; None: it is not there."""
    if not path.is_file():
        return None
    notes = _notes(path)
    if notes.get("fingerprint") != part.fingerprint:
        if part.images[0].overwrite:
            return None
        problem = "made from other images or with other settings"
        return [Outcome({"error": f"{path} exists, {problem}; --overwrite replaces it"}, True)] * len(part.images)
    rows: dict[str, dict[str, Any]] = dict(zip(json.loads(notes["names"]), json.loads(notes["rows"]), strict=True))
    rows |= {name: {"error": error} for name, error in json.loads(notes["errors"]).items()}
    return [Outcome(rows[job.image.name], False) for job in part.images]


def _notes(path: Path) -> dict[str, str]:
    """Return the metadata of a shard or a part; empty where it is not there, or none."""
    from kcgs.storage import map_file

    try:
        return map_file(path).metadata
    except (OSError, ValueError):
        return {}


def complete_shard(parts: Sequence[ShardPart]) -> None:
    """Write a shard from its parts, and remove these; nothing where the shard is there, or no image was fitted."""
    from kcgs.data import save_shard, stack_scenes
    from kcgs.files import load

    scenes = [load(part.path) for part in parts if part.path.is_file()]
    if not scenes:
        return
    names, psnr, rows = [], [], []
    errors: dict[str, str] = {}
    for scene in scenes:
        notes = scene.metadata
        names += json.loads(notes["names"])
        psnr += json.loads(notes["psnr"])
        rows += json.loads(notes["rows"])
        errors |= json.loads(notes["errors"])
    notes = {"fingerprint": parts[0].fingerprint, "rows": json.dumps(rows), "errors": json.dumps(errors)}
    joined = stack_scenes([one for scene in scenes for one in scene], scenes[0].num_gaussians)
    save_shard(parts[0].shard, joined, names, psnr, notes)
    for part in parts:
        part.path.unlink(missing_ok=True)
