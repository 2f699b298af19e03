"""The job of `kcgs fit-many --shard` for a batch of images, which makes a part of a shard; and shards from parts."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from .many_fingerprints import FitJob, fingerprint_of_part
from .many_jobs import FileBatch, Loaded, Outcome, failure, fit_batch, load_job
from .reports import replace_undefined


class ShardPart(NamedTuple):
    """Images that are fitted together, and the place of their scenes until the shard is complete."""

    shard: Path
    number: int
    """Number of the part in the shard."""
    images: tuple[FitJob, ...]
    size: tuple[int, int] | None
    """(height, width) of all images; None: their files could not be read."""
    fingerprint: str
    """Fingerprint of the whole shard."""

    @property
    def path(self) -> Path:
        """The file of the part, in a folder beside the shard."""
        from kcgs.data import shard_path

        return shard_path(self.shard.with_suffix(".parts"), self.number)

    @property
    def own_fingerprint(self) -> str:
        """Fingerprint of the part's file: with another batch size, the same shard has other parts."""
        return fingerprint_of_part(self.fingerprint, self.images)

    def run(self) -> list[Outcome]:
        """Fit the images and write their scenes, unless these are in the shard or in the part's file."""
        return (
            _read_outcomes(self, self.shard, self.fingerprint)
            or _read_outcomes(self, self.path, self.own_fingerprint)
            or _fit_part(self)
        )

    def count_done(self) -> int:
        """Count the images whose scenes are on disk."""
        files = {self.shard: self.fingerprint, self.path: self.own_fingerprint}
        return len(self.images) * any(_fingerprint_in(path) == own for path, own in files.items())


class Shards:
    """The shards of a command, if any; each shard is written once all its parts are fitted."""

    def __init__(self, work: Sequence[FileBatch | ShardPart]) -> None:
        self._parts: dict[Path, list[ShardPart]] = {}
        for part in work:
            if isinstance(part, ShardPart):
                self._parts.setdefault(part.shard, []).append(part)
        self._rows: dict[Path, dict[str, dict[str, Any]]] = {shard: {} for shard in self._parts}

    def check(self) -> None:
        """Refuse existing shards of other images or other settings, unless they may be replaced."""
        for shard, (part, *_) in self._parts.items():
            is_kept = shard.is_file() and not part.images[0].overwrite
            if is_kept and _fingerprint_in(shard) != part.fingerprint:
                problem = "is damaged, or was made from other images or with other settings"
                raise FileExistsError(f"{shard} {problem}; --overwrite replaces such shards")

    def add(self, part: FileBatch | ShardPart, outcomes: Sequence[Outcome]) -> None:
        """Count a part as done, and write its shard if this was the last part."""
        if not isinstance(part, ShardPart):
            return
        rows, parts = self._rows[part.shard], self._parts[part.shard]
        rows |= {job.image.name: outcome.row for job, outcome in zip(part.images, outcomes, strict=True)}
        if len(rows) == sum(len(each.images) for each in parts):
            _complete(parts, {name: row["error"] for name, row in rows.items() if "error" in row})


def _fit_part(part: ShardPart) -> list[Outcome]:
    """Fit the images of a part, and write their scenes."""
    outcomes: dict[int, Outcome] = {}
    loaded: dict[int, Loaded] = {}
    for index, job in enumerate(part.images):
        try:
            one = load_job(job)
            size = (one.image.shape[1], one.image.shape[2])
            if part.size not in (None, size):
                raise ValueError(f"it has {size[1]} x {size[0]} pixels, others of its shard have another size")
            loaded[index] = one
        except Exception as error:
            outcomes[index] = failure(error)
    if loaded:
        outcomes |= _fit_loaded(part, loaded, {index: outcome.row["error"] for index, outcome in outcomes.items()})
    return [outcomes[index] for index in range(len(part.images))]


def _fit_loaded(part: ShardPart, loaded: dict[int, Loaded], errors: dict[int, str]) -> dict[int, Outcome]:
    """Fit images of the same shape, and write the part."""
    from kcgs.data import save_shard, stack_scenes
    from kcgs.fitting import rank_gaussians
    from kcgs.nn import reorder_rows
    from kcgs.scene import Scene

    request = part.images[0].request
    try:
        fits = fit_batch([*loaded.values()], request)
    except Exception as error:  # images and maps were read, so the error is of the whole part
        return {index: failure(error) for index in loaded}
    with_maps = any(one.labels is not None for one in loaded.values())
    singles = [fit.result.scene for fit in fits]
    scenes = stack_scenes(singles, request.count_for(*singles[0].size), with_maps=with_maps)
    field = reorder_rows(scenes.field, rank_gaussians(scenes.field, scenes.regions))
    scenes = Scene(field, scenes.regions).to("cpu")
    names = [part.images[index].image.name for index in loaded]
    psnr = [float(fit.result.psnr) for fit in fits]
    rows = [
        replace_undefined({"psnr": number, "num_gaussians": scene.num_gaussians, "seconds": fit.seconds})
        for number, scene, fit in zip(psnr, singles, fits, strict=True)
    ]
    failed = {part.images[index].image.name: error for index, error in errors.items()}
    notes = {"fingerprint": part.own_fingerprint, "rows": json.dumps(rows), "errors": json.dumps(failed)}
    part.path.parent.mkdir(exist_ok=True)
    save_shard(part.path, scenes, names, psnr, notes)
    return {
        index: Outcome(row, True, (*one.warnings, *fit.warnings))
        for (index, one), fit, row in zip(loaded.items(), fits, rows, strict=True)
    }


def _read_outcomes(part: ShardPart, path: Path, fingerprint: str) -> list[Outcome] | None:
    """Return the rows of a part from a file of the same images and settings; None: there is no such file."""
    notes = _notes(path)
    if notes.get("fingerprint") != fingerprint:
        return None
    rows: dict[str, dict[str, Any]] = dict(zip(json.loads(notes["names"]), json.loads(notes["rows"]), strict=True))
    rows |= {name: {"error": error} for name, error in json.loads(notes["errors"]).items()}
    return [Outcome(rows[job.image.name], False) for job in part.images]


def _fingerprint_in(path: Path) -> str | None:
    return _notes(path).get("fingerprint")


def _notes(path: Path) -> dict[str, str]:
    """Return the metadata of a shard or a part; empty if the file does not exist or is no shard."""
    from kcgs.storage import map_file

    try:
        return map_file(path).metadata
    except (OSError, ValueError):
        return {}


def _complete(parts: Sequence[ShardPart], errors: Mapping[str, str]) -> None:
    """Write a shard from its parts, unless it exists or no image was fitted; then remove the parts.

    Args:
        parts: all parts of the shard.
        errors: messages of images that failed, by name.
    """
    from kcgs.data import save_shard, shard_contents, stack_scenes
    from kcgs.files import load

    shard, fingerprint = parts[0].shard, parts[0].fingerprint
    # the shard may exist: an earlier command was perhaps killed while it removed the parts
    is_there = _fingerprint_in(shard) == fingerprint
    scenes = [] if is_there else [load(part.path) for part in parts if part.path.is_file()]
    if scenes:
        names, psnr, rows = [], [], []
        for scene in scenes:
            part_names, part_psnr = shard_contents(scene.metadata, shard)
            names += part_names
            psnr += part_psnr
            rows += json.loads(scene.metadata["rows"])
        notes = {"fingerprint": fingerprint, "rows": json.dumps(rows), "errors": json.dumps(errors)}
        singles = [one for scene in scenes for one in scene]
        joined = stack_scenes(singles, scenes[0].num_gaussians, with_maps=scenes[0].regions is not None)
        save_shard(shard, joined, names, psnr, notes)
    shutil.rmtree(parts[0].path.parent, ignore_errors=True)
