"""Fingerprints of images, masks and settings, by which `kcgs fit-many` finds the files that it need not make again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from kcgs._atomic import write_file

from .options import FitRequest


class FitJob(NamedTuple):
    """An image to be fitted, and the options of its fit."""

    image: Path
    output: Path
    """File of the scene."""
    regions: str
    """auto, none, or the path of the mask."""
    request: FitRequest
    overwrite: bool = False
    """Replace a scene that has another image, mask or settings, or that was changed since."""
    resize_regions: bool = False
    threshold: float | None = None
    """Threshold of masks with soft edges."""

    @property
    def record(self) -> Path:
        """File beside the scene with its fingerprint; once the scene is complete, also its row and a checksum."""
        return self.output.with_suffix(".json")


def fingerprint_of(job: FitJob) -> str:
    """Hash the image, the mask and all settings."""
    mask = job.regions.encode() if job.regions in ("auto", "none") else Path(job.regions).read_bytes()
    return _hash(b"\0".join((_describe_settings(job).encode(), job.image.read_bytes(), mask)))


def fingerprint_of_shard(jobs: Sequence[FitJob]) -> str:
    """Hash the settings, and the names and sizes of images and masks, but not their contents: there may be millions.

    A mask of another size is an error of its image, which a shard keeps; so with --resize-regions a shard is another.
    """
    files = [(job.image.name, _bytes(job.image), _bytes(Path(job.regions)) or job.regions) for job in jobs]
    contents = (_describe_settings(jobs[0]), files, *(["resized"] if jobs[0].resize_regions else []))
    return _hash(repr(contents).encode())


def fingerprint_of_part(fingerprint: str, jobs: Sequence[FitJob]) -> str:
    """Hash the fingerprint of a shard and the names of the images of a part."""
    return _hash(repr((fingerprint, [job.image.name for job in jobs])).encode())


def _describe_settings(job: FitJob) -> str:
    """Return all settings that a scene depends on, besides the image and the mask, as text."""
    request = job.request
    settings: tuple[Any, ...] = (
        request.load_config().model_dump_json(), request.num_gaussians, request.target_bytes, request.seed,
    )  # fmt: skip
    settings += ("grey",) if request.is_grey else ()
    return repr(settings if job.threshold is None else (*settings, job.threshold))


def _bytes(path: Path) -> int | None:
    return path.stat().st_size if path.is_file() else None


def _hash(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def mark_started(job: FitJob, fingerprint: str) -> None:
    """Write the record of an unfinished scene: if the command is killed, the next one knows the scene as its own."""
    write_file(job.record, json.dumps({"fingerprint": fingerprint}))


def write_row(job: FitJob, row: dict[str, Any]) -> None:
    """Write the record of a complete scene; the row has its fingerprint."""
    write_file(job.record, json.dumps({**row, "checksum": _checksum(job, row)}))


def existing_row(job: FitJob, fingerprint: str) -> dict[str, Any] | None:
    """Return the row of an unchanged scene, else None; without --overwrite, refuse to replace a file."""
    record = _read_record(job)
    if not job.output.is_file():
        if job.record.is_file() and "fingerprint" not in record and not job.overwrite:
            raise FileExistsError(f"{job.record} exists, and was not written by kcgs fit-many; --overwrite replaces it")
        return None
    row = _valid_row(job, fingerprint)
    is_unfinished = record == {"fingerprint": fingerprint}
    if row is None and not (is_unfinished or job.overwrite):
        problem = "made with other settings or changed since"
        raise FileExistsError(f"{job.output} exists, {problem}; --overwrite replaces it")
    return row


def is_done(job: FitJob) -> bool:
    """Whether the scene exists, made from the same image, mask and settings, and unchanged."""
    try:
        return _valid_row(job, fingerprint_of(job)) is not None
    except OSError:
        return False


def _valid_row(job: FitJob, fingerprint: str) -> dict[str, Any] | None:
    """Return the row of a scene if its fingerprint and checksum are right, else None."""
    row = _read_record(job)
    checksum = row.pop("checksum", None)
    is_same = row.get("fingerprint") == fingerprint and checksum == _checksum(job, row)
    return row if is_same else None


def _read_record(job: FitJob) -> dict[str, Any]:
    """Read the record of a scene; return an empty one if there is no readable one."""
    try:
        record = json.loads(job.record.read_bytes())
    except (FileNotFoundError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}


def _checksum(job: FitJob, row: dict[str, Any]) -> str:
    """Hash a scene and its row."""
    return _hash(job.output.read_bytes() + json.dumps(row).encode())
